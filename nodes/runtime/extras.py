"""Installation hints for packages that a base installation, such as the car's, does not have."""

from __future__ import annotations

from importlib.util import find_spec

# Without a separate index, pip installs torch for CUDA, with several GB of NVIDIA's packages.
CPU_TORCH = "pip install torch --index-url https://download.pytorch.org/whl/cpu"
_EXTRA_OF = dict.fromkeys(("torch", "numba", "scipy", "matplotlib", "jinja2", "av"), "core") | {
    "mujoco": "twin",
    "pycolmap": "sfm",
    "trimesh": "mesh",
    "viser": "view",
    "onnxruntime": "onnx",
    "onnx": "onnx",
    "mitsuba": "mesh",
    "drjit": "mesh",
    "ray": "cluster",
    "carla": "carla",
    "pyarrow": "lerobot",
    "gsply": "splats",
    "carla_driver_interface": "egodriver",
    "scenariogeneration": "audit",
    "sarif_pydantic": "audit",
    "junitparser": "audit",
    "starlette": "page",
    "uvicorn": "page",
    "cryptography": "page",
}


def installs(package: str) -> str | None:
    """Command that installs an optional package; None if no extra has it."""
    if (extra := _EXTRA_OF.get(package)) is None:
        return None
    command = f"pip install 'advnerf[{extra}]'"
    if extra != "core" or find_spec("torch") is not None:
        return command
    return f"{command}; without an NVIDIA GPU first {CPU_TORCH}, which saves several GB"
