// Shades a G-buffer by ONNX Runtime: shade MODEL WIDTH HEIGHT < gbuffer.f32 > shade.f32
// Planes of float32, one channel after the other, row 0 on top; sides are padded multiples of 64.
#include <onnxruntime_cxx_api.h>

#include <cstdlib>
#include <iostream>
#include <vector>

int main(int count, char** words) try {
  if (count != 4) throw std::runtime_error("usage: shade MODEL WIDTH HEIGHT < in.f32 > out.f32");
  const int64_t width = std::atoll(words[2]), height = std::atoll(words[3]);
  Ort::Env environment;
  Ort::Session session(environment, words[1], Ort::SessionOptions{});
  const int64_t channels = session.GetInputTypeInfo(0).GetTensorTypeAndShapeInfo().GetShape()[1];
  const std::vector<int64_t> shape{1, channels, height, width};
  std::vector<float> gbuffer(channels * height * width);
  const std::streamsize bytes = gbuffer.size() * sizeof(float);
  if (!std::cin.read(reinterpret_cast<char*>(gbuffer.data()), bytes))
    throw std::runtime_error("the input holds fewer than " + std::to_string(bytes) + " bytes");
  const auto memory = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
  const auto input = Ort::Value::CreateTensor<float>(memory, gbuffer.data(), gbuffer.size(),
                                                     shape.data(), shape.size());
  const char *taken = "gbuffer", *given = "shade";
  const auto shade = session.Run(Ort::RunOptions{}, &taken, &input, 1, &given, 1);
  std::cout.write(reinterpret_cast<const char*>(shade[0].GetTensorData<float>()),
                  shade[0].GetTensorTypeAndShapeInfo().GetElementCount() * sizeof(float));
} catch (const std::exception& error) {
  std::cerr << error.what() << '\n';
  return 1;
}
