"""The CUDA kernels become PTX for real GPUs; that needs the compiler (``pip install -e '.[gpu]'``), but no device."""

import pytest

pytest.importorskip("numba_cuda", reason="needs the extra gpu")
from numba import cuda, types
from numba.cuda import dispatcher

from advnerf_core.render import cast_cuda_kernels
from advnerf_core.scene import baked_cuda

pytestmark = pytest.mark.gpu
F8, I8, I4, U1, F4 = types.float64, types.int64, types.int32, types.uint8, types.float32


def arrays(*kinds):
    return [types.Array(kind, dimensions, "C") for kind, dimensions in kinds]


def objects(kind):
    return [
        *arrays((F8, 3), (I4, 3), (F8, 1)),
        I8,
        *arrays((I8, 2), (F8, 2), (I4, 1), (kind, 1), (U1, 1), (kind, 3), (I4, 1)),
    ]


def draw(kind):
    return [*objects(kind), *arrays((kind, 3)), F8, *arrays((kind, 4), (kind, 4), (I8, 2))]


def pull(kind):
    return [*objects(kind), *arrays((kind, 4), (kind, 4), (F8, 1), (I8, 3))]


BAKED = [*arrays((F4, 3), (F4, 1), (F4, 1)), F8, *arrays((F4, 1), (U1, 3), (F4, 1), (I4, 3), (U1, 3), (I4, 1), (F4, 1)), F8, I8,
         *arrays((F4, 4), (F4, 3))]  # fmt: skip
KERNELS = {
    "draw, float32": (cast_cuda_kernels.draw_objects, draw(F4)),
    "draw, float64": (cast_cuda_kernels.draw_objects, draw(F8)),
    "pull, float32": (cast_cuda_kernels.pull_objects, pull(F4)),
    "baked": (baked_cuda.render_baked_cuda, BAKED),
}


@pytest.mark.parametrize("capability", [(7, 5), (8, 7), (9, 0)], ids=["Turing", "Orin", "Hopper"])
@pytest.mark.parametrize("name", KERNELS)
def test_a_kernel_compiles(name, capability, monkeypatch):
    class Named:
        compute_capability = capability

    # Numba asks the present device which code to make of functions that kernels call.
    monkeypatch.setattr(dispatcher, "get_current_device", lambda: Named)
    kernel, signature = KERNELS[name]
    ptx, _ = cuda.compile(kernel.py_func, tuple(signature), cc=capability, device=False, abi="numba")
    assert f".target sm_{capability[0]}{capability[1]}" in ptx
    if name == "pull, float32":
        assert ptx.count("atom.global.add.u64") + ptx.count("red.global.add.u64") > 0
    if name == "baked":  # all of it in single precision
        assert not [
            line
            for line in ptx.splitlines()
            if ".f64" in line and line.split()[0].startswith(("mul", "add", "fma", "div", "sqrt"))
        ]
