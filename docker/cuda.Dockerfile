# CompGS on NVIDIA GPUs: training, encoding and drawing with gsplat. In the project's folder:
#
#   docker build -f docker/cuda.Dockerfile -t compgs:cuda .
#   docker run --rm --gpus all -v "$PWD:/data" compgs:cuda train scenes/garden -o runs/garden
#
# A folder of splats, each as .cgs, with a table of sizes:
#
#   docker run --rm --gpus all -v "$PWD:/data" --entrypoint compgs-convert compgs:cuda splats -o small --to cgs --time 5min
#
# The compiler stays in the image: gsplat compiles its kernels for the GPU that it finds, once, before the first step.
# Keep them from one container to the next with `-v compgs-kernels:/var/cache/compgs`.

FROM python:3.11-slim AS wheel
WORKDIR /source
COPY pyproject.toml README.md LICENSE ./
COPY src src
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels .

FROM nvidia/cuda:12.8.1-devel-ubuntu24.04
# The base's versions are those of its tag.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3 python3-dev python3-venv ninja-build \
    && rm -rf /var/lib/apt/lists/*
RUN python3 -m venv /opt/compgs
ENV PATH=/opt/compgs/bin:$PATH
ARG EXTRAS=train,cuda,spz
COPY --from=wheel /wheels /wheels
RUN pip install --no-cache-dir "$(echo /wheels/*.whl)[${EXTRAS}]" && rm -r /wheels
COPY --chmod=755 docker/compgs-convert /usr/local/bin/compgs-convert
COPY tools/convert_folder.py /usr/local/share/compgs/convert_folder.py
ENV NUMBA_CACHE_DIR=/var/cache/compgs/numba TORCH_EXTENSIONS_DIR=/var/cache/compgs/torch
RUN mkdir -m 1777 /var/cache/compgs
WORKDIR /data
ENTRYPOINT ["compgs"]
CMD ["--help"]
