# The car's own computer, arm64 or amd64: devices, nodes, bags; no torch, no simulator. From the repository root, on the car:
#   docker build -f docker/Dockerfile.robot -t advnerf-robot .
# With --build-arg EXTRAS=[core] also torch, so that the policy node can run beside the others.
FROM python:3.11-slim

WORKDIR /advnerf
ARG EXTRAS=
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
ENV PIP_EXTRA_INDEX_URL=${TORCH_INDEX} PIP_NO_CACHE_DIR=1 PIP_ROOT_USER_ACTION=ignore
COPY . .
RUN pip install -c constraints.txt ".${EXTRAS}"

CMD ["advnerf", "doctor"]
