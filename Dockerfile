# docker build --tag raytran .
# docker run --rm --gpus all --ipc host -v "$PWD:/work" raytran -m raytran.predict scene=walk output=prediction
#
# CUDA comes with torch from PyPI, which brings its libraries (13.0: a driver of 580 or newer); of the host nothing but the driver and
# NVIDIA's container toolkit is needed, and none of it without --gpus. All versions are those of uv.lock, each file checked by its hash.
FROM python:3.12-slim-bookworm

# Triton compiles a stub in C for each kernel. Version of a compiler: whatever the base image's Debian has.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install --no-install-recommends --yes gcc libc6-dev \
    && rm -rf /var/lib/apt/lists/*

# What NVIDIA's toolkit is to mount into a container whose image is none of theirs.
ENV NVIDIA_VISIBLE_DEVICES=all NVIDIA_DRIVER_CAPABILITIES=compute,utility

ENV UV_PROJECT_ENVIRONMENT=/opt/raytran UV_LINK_MODE=copy UV_COMPILE_BYTECODE=1 UV_NO_CACHE=1
ARG EXTRAS="--extra video --extra colmap --extra heic --extra viewer --extra hub --extra tensorboard"

WORKDIR /opt/source
RUN pip install --no-cache-dir uv==0.13.9
COPY pyproject.toml uv.lock ./
# shellcheck disable=SC2086
RUN uv sync --frozen --no-install-project ${EXTRAS}
COPY . .
# shellcheck disable=SC2086
RUN uv sync --frozen --no-editable ${EXTRAS}

ENV PATH=/opt/raytran/bin:$PATH
WORKDIR /work
ENTRYPOINT ["python"]
CMD ["-m", "raytran"]
