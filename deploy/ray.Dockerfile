# Ray's head and its workers, which render, from the repository's root:
#   docker build -f deploy/ray.Dockerfile -t deepshade/ray .
ARG BASE=python:3.11.14-slim-bookworm

FROM ${BASE} AS build
WORKDIR /src
COPY . ./
RUN python3 -m venv /opt/deepshade
RUN /opt/deepshade/bin/pip install --no-cache-dir --no-compile -c constraints.txt '.[workers,tracing]' && \
    /opt/deepshade/bin/pip uninstall -y pip

FROM ${BASE}
RUN apt-get update -qq && \
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends libllvm19 libatomic1 && \
    rm -rf /var/lib/apt/lists/*
RUN useradd --uid 10001 --no-create-home --shell /usr/sbin/nologin deepshade && \
    mkdir -p /jobs/rendered /shards /library && chown -R 10001:10001 /jobs /shards /library
COPY --from=build /opt/deepshade /opt/deepshade
ENV PATH=/opt/deepshade/bin:/usr/local/bin:/usr/bin:/bin PYTHONUNBUFFERED=1 \
    PYTHONDONTWRITEBYTECODE=1 HOME=/tmp RAY_USAGE_STATS_ENABLED=0
WORKDIR /shards
USER 10001:10001
EXPOSE 6379 8265 10001
# of this node; its agent, which takes jobs, answers it without a token
HEALTHCHECK --interval=10s --timeout=8s --start-period=120s --retries=3 \
    CMD ["python3", "-m", "deepshade.health", "http://127.0.0.1:52365/api/local_raylet_healthz"]
CMD ["ray", "start", "--head", "--port=6379", "--dashboard-host=0.0.0.0", "--num-cpus=0", "--block"]
