// The same by OpenVINO: shade_openvino MODEL WIDTH HEIGHT < gbuffer.f32 > shade.f32
#include <cstdlib>
#include <iostream>
#include <openvino/openvino.hpp>
#include <vector>

int main(int count, char** words) try {
  if (count != 4) throw std::runtime_error("usage: shade MODEL WIDTH HEIGHT < in.f32 > out.f32");
  const size_t width = std::atoll(words[2]), height = std::atoll(words[3]);
  ov::Core core;
  const auto model = core.read_model(words[1]);
  const size_t channels = model->input().get_partial_shape()[1].get_length();
  model->reshape(ov::PartialShape{1, int64_t(channels), int64_t(height), int64_t(width)});
  auto compiled = core.compile_model(model, "CPU", ov::hint::inference_precision(ov::element::f32));
  auto request = compiled.create_infer_request();
  std::vector<float> gbuffer(channels * height * width);
  const std::streamsize bytes = gbuffer.size() * sizeof(float);
  if (!std::cin.read(reinterpret_cast<char*>(gbuffer.data()), bytes))
    throw std::runtime_error("the input holds fewer than " + std::to_string(bytes) + " bytes");
  request.set_input_tensor(
      ov::Tensor(ov::element::f32, {1, channels, height, width}, gbuffer.data()));
  request.infer();
  const auto shade = request.get_output_tensor();
  std::cout.write(reinterpret_cast<const char*>(shade.data<float>()), shade.get_byte_size());
} catch (const std::exception& error) {
  std::cerr << error.what() << '\n';
  return 1;
}
