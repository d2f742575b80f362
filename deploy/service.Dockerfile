# The shading service, from the repository's root:
#   docker build -f deploy/service.Dockerfile -t deepshade/service .
# A digest pins the base harder than a tag: --build-arg BASE=python@sha256:...
ARG BASE=python:3.11.14-slim-bookworm

FROM ${BASE} AS build
WORKDIR /src
COPY . ./
RUN python3 -m venv /opt/deepshade
# (OpenVINO tells its makers of its use, from a process of its own, unless a package is missing)
# onnxruntime-gpu in place of onnxruntime serves on NVIDIA's (deploy/gpu.yml)
ARG ENGINE=onnxruntime
RUN /opt/deepshade/bin/pip install --no-cache-dir --no-compile -c constraints.txt '.[service,tracing]' && \
    if [ "$ENGINE" != onnxruntime ]; then \
        /opt/deepshade/bin/pip uninstall -y onnxruntime && \
        /opt/deepshade/bin/pip install --no-cache-dir --no-compile -c constraints.txt "$ENGINE"; \
    fi && \
    /opt/deepshade/bin/pip uninstall -y openvino-telemetry pip

FROM ${BASE}
# the folders are there, and ours, so that new volumes become ours
RUN useradd --uid 10001 --no-create-home --shell /usr/sbin/nologin deepshade && \
    mkdir /models /environments && chown 10001:10001 /models /environments
COPY --from=build /opt/deepshade /opt/deepshade
ENV PATH=/opt/deepshade/bin:/usr/local/bin:/usr/bin:/bin PYTHONUNBUFFERED=1 \
    PYTHONDONTWRITEBYTECODE=1 HOME=/tmp DEEPSHADE_MODELS=/models:shipped
WORKDIR /models
USER 10001:10001
EXPOSE 8000
HEALTHCHECK --interval=10s --timeout=5s --start-period=60s --retries=3 \
    CMD ["python3", "-m", "deepshade.health", "http://127.0.0.1:8000/readyz"]
CMD ["deepshade", "serve", "--host", "0.0.0.0", "--port", "8000", "--environments", "/environments"]
