# The trainer service, from the repository's root:
#   docker build -f deploy/trainer.Dockerfile -t deepshade/trainer .
# It drives Ray, so it must have the Python and Ray of deploy/ray.Dockerfile.
ARG BASE=python:3.11.14-slim-bookworm

FROM ${BASE} AS build
WORKDIR /src
COPY . ./
RUN python3 -m venv /opt/deepshade
# (OpenVINO tells its makers of its use, from a process of its own, unless a package is missing)
# PyTorch's build: cpu, or cu130 for NVIDIA's (deploy/gpu.yml); PyPI's own is several gigabytes
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
RUN /opt/deepshade/bin/pip install --no-cache-dir --no-compile -c constraints.txt \
        --extra-index-url ${TORCH_INDEX} '.[trainer,workers,client,postgres,tracing]' && \
    /opt/deepshade/bin/pip uninstall -y openvino-telemetry pip

FROM ${BASE}
# Mitsuba compiles with libLLVM, for jobs that render here rather than on Ray
RUN apt-get update -qq && \
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends libllvm19 libatomic1 && \
    rm -rf /var/lib/apt/lists/*
RUN useradd --uid 10001 --no-create-home --shell /usr/sbin/nologin deepshade && \
    mkdir -p /models /jobs/rendered /shards /library && \
    chown -R 10001:10001 /models /jobs /shards /library
COPY --from=build /opt/deepshade /opt/deepshade
ENV PATH=/opt/deepshade/bin:/usr/local/bin:/usr/bin:/bin PYTHONUNBUFFERED=1 \
    PYTHONDONTWRITEBYTECODE=1 HOME=/tmp RAY_USAGE_STATS_ENABLED=0
# datagen has Ray's workers enter the folder that it is run in: the same in both images
WORKDIR /shards
USER 10001:10001
EXPOSE 8001
HEALTHCHECK --interval=10s --timeout=5s --start-period=60s --retries=3 \
    CMD ["python3", "-m", "deepshade.health", "http://127.0.0.1:8001/readyz"]
CMD ["deepshade-trainer", "serve", "--host", "0.0.0.0", "--port", "8001", "--folder", "/jobs", \
    "--published", "/models", "--data", "/shards", "--library", "/library"]
