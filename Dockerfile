# soro_bench on an NVIDIA GPU: docker build -t soro_bench . && docker run --gpus all soro_bench train TrunkReach-v0 --device cuda
FROM nvidia/cuda:12.8.1-base-ubuntu24.04
RUN apt-get update && apt-get install -y --no-install-recommends python3 python3-venv libegl1 libgl1 \
    && rm -rf /var/lib/apt/lists/*
ENV MUJOCO_GL=egl PATH=/opt/soro_bench/bin:$PATH
WORKDIR /soro_bench
COPY . .
RUN python3 -m venv /opt/soro_bench && pip install --no-cache-dir '.[gpu,view,report]'
ENTRYPOINT ["soro-bench"]
