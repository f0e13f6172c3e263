# docker build -t invertwin . && docker run --rm invertwin        runs the demo
# .devcontainer/devcontainer.json uses the first stage with the checkout mounted.
FROM python:3.12-slim-trixie AS system
RUN apt-get update \
    && apt-get install -y --no-install-recommends git libatomic1 libllvm19 make \
    && rm -rf /var/lib/apt/lists/*
# Smaller builds of PyTorch, for CPUs; override it where the host lends a GPU.
ENV PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu

FROM system AS demo
WORKDIR /invertwin
COPY . .
RUN make .venv/.run .venv/.llvm
CMD ["make", "demo"]
