# cfx in a container: a job, or a worker of a Dask cluster.
#
#   docker build --tag cfx .                                     CPU
#   docker build --tag cfx:cuda --build-arg TORCH_INDEX= .       PyTorch's build with CUDA, from PyPI
#   docker run --rm --volume "$PWD/outputs:/work/outputs" cfx    the job of `make run`
#   docker run --rm cfx dask worker tcp://SCHEDULER:8786 --nthreads 1
ARG PYTHON=3.12
FROM python:${PYTHON}-slim-bookworm AS build

# The compiler makes kernels for the processor that the container runs on, so the image that runs has it too.
# Its version is Debian's of the day, with its security fixes.
# hadolint ignore=DL3008
RUN apt-get update && apt-get install --yes --no-install-recommends g++ && rm -rf /var/lib/apt/lists/*
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
WORKDIR /src
COPY constraints.txt ./
RUN python -m venv /opt/cfx
RUN if [ -n "$TORCH_INDEX" ]; then \
      /opt/cfx/bin/pip install --no-cache-dir --no-deps --index-url "$TORCH_INDEX" "$(grep '^torch==' constraints.txt)"; \
    fi
COPY pyproject.toml README.md LICENSE CITATION.cff ./
COPY cfx ./cfx
COPY conf ./conf
COPY plugins/cfx-dask ./plugins/cfx-dask
COPY plugins/cfx-recordings ./plugins/cfx-recordings
COPY plugins/cfx-report ./plugins/cfx-report
ARG EXTRAS=dask,joblib,postgresql,s3
RUN /opt/cfx/bin/pip install --no-cache-dir --constraint constraints.txt ".[$EXTRAS]" ./plugins/cfx-dask ./plugins/cfx-recordings ./plugins/cfx-report

FROM python:${PYTHON}-slim-bookworm
# hadolint ignore=DL3008
RUN apt-get update && apt-get install --yes --no-install-recommends g++ && rm -rf /var/lib/apt/lists/* \
  && useradd --create-home --uid 1000 cfx && install --directory --owner cfx /work
COPY --from=build /opt/cfx /opt/cfx
# A scheduler would keep its last 1,000 messages to each worker, and a shard is one.
ENV PATH=/opt/cfx/bin:$PATH OMP_NUM_THREADS=1 MLFLOW_DISABLE_TELEMETRY=true DASK_DISTRIBUTED__ADMIN__LOW_LEVEL_LOG_LENGTH=1
# By number: Kubernetes cannot know that a name is not root.
USER 1000
WORKDIR /work
# Without words after the image's name: the job of `make run`. `cfx ...`, `dask worker ...` and anything else run as they are.
CMD ["cfx"]
