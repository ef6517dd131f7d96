# The car's own computer, arm64 or amd64: devices, nodes, bags, and policies as ONNX; no torch, no simulator. From the repository root:
#   docker build -f docker/Dockerfile.robot -t advnerf-robot .                                         on the car
#   docker buildx build --platform linux/arm64 -f docker/Dockerfile.robot -t advnerf-robot --load .    on another machine
# EXTRAS: [onnx] runs exported policies beside the nodes, [onnx,oak] also a DepthAI camera, [core] policies of torch; empty: nodes only.
FROM python:3.11-slim

WORKDIR /advnerf
ARG EXTRAS=[onnx]
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
ENV PIP_EXTRA_INDEX_URL=${TORCH_INDEX} PIP_NO_CACHE_DIR=1 PIP_ROOT_USER_ACTION=ignore
# Dependencies first: a change of the code does not install them again.
COPY pyproject.toml constraints.txt README.md ./
RUN mkdir advnerf_core hardware calibration nodes \
 && touch advnerf_core/__init__.py hardware/__init__.py calibration/__init__.py nodes/__init__.py \
 && pip install -c constraints.txt ".${EXTRAS}" && pip uninstall -q -y advnerf
COPY . .
RUN pip install --no-deps .

# As Ctrl-C does: the motor node brakes, the recorder ends its bag.
STOPSIGNAL SIGINT
CMD ["advnerf", "doctor"]
