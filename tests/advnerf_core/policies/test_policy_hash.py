"""The hash of a policy changes when a file that it reads changes, and only then."""

import importlib
import socketserver
import sys
import threading

import numpy as np
import onnx
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from advnerf_core.files import sha256_of
from advnerf_core.policies.load import load_any_policy, load_driver, policy_file_sha256
from advnerf_core.policies.onnx_policy import OnnxNetwork
from tests.support.onnx_models import mean_model, save_beside, steering

QUICK = settings(max_examples=15, suppress_health_check=list(HealthCheck))
GAINS = st.sampled_from([0.25, 0.5, -1.0, 2.0])


def same_exactly_where_equal(states, hashes):
    """Whether two hashes are equal exactly where the states that they name are."""
    pairs = set(zip(states, hashes, strict=True))
    return len(pairs) == len(set(states)) == len(set(hashes))


def write_onnx(folder, first, second, mean, text, unrelated):
    model = mean_model({"steering": first, "other": second})
    for tensor, location in zip(model.graph.initializer, ("a.data", "in/b.data"), strict=True):
        onnx.external_data_helper.set_external_data(tensor, location)
    model.doc_string = text
    (folder / "in").mkdir(exist_ok=True)
    for name in ("a.data", "in/b.data"):
        (folder / name).unlink(missing_ok=True)  # onnx would append to it
    save_beside(model, folder / "policy.onnx", {"output_name": "steering", "mean": mean})
    for name in ("notes.txt", "c.data", "in/a.data", "policy.onnx.data", "other.onnx.policy.yaml", "help.py"):
        (folder / name).write_text(unrelated)
    return folder / "policy.onnx"


@QUICK
@given(
    states=st.lists(
        st.tuples(GAINS, GAINS, st.sampled_from([0.0, 0.5]), st.sampled_from(["", "v2"])), max_size=3
    ),
    unrelated=st.lists(st.text(alphabet="ab", max_size=2), min_size=3, max_size=3),
)
def test_of_an_onnx_file_with_weights_elsewhere(tmp_path_factory, states, unrelated):
    folder, hashes = tmp_path_factory.mktemp("onnx"), []
    for state, text in zip(states, unrelated, strict=False):
        network = OnnxNetwork(write_onnx(folder, *state, text))
        hashes.append(network.sha256)
        gain, _, mean, _ = state
        assert steering(network, 0.5) == pytest.approx([gain * (0.5 - mean)] * 2)
    assert same_exactly_where_equal(states, hashes)


NET = """
import torch
from my_policy_pack.parts import gain
def factory():
    from advnerf_core import PolicyContract, PolicyView, adapt
    from advnerf_core.geometry import Pinhole
    view = PolicyView(Pinhole(12, 8, 6.0, 6.0, 6.0, 4.0), 0, 8, 12, 8)
    return adapt(lambda images: {factor} * gain.GAIN * images.mean((1, 2, 3)), PolicyContract(view))
"""


def write_package(folder, factor, gain, unread, unrelated):
    pack = folder / "my_policy_pack"
    (pack / "parts").mkdir(parents=True, exist_ok=True)
    files = {
        "__init__.py": "",
        "net.py": NET.format(factor=factor),
        "parts/__init__.py": "",
        "parts/gain.py": f"GAIN = {gain}\n",
        "parts/by_name_only.py": f"# {unread}\n",  # importlib may reach it, so it counts
        "notes.txt": unrelated,
        "../beside.py": f"# {unrelated}\n",
        "parts/__pycache__/gain.pyc": unrelated,
    }
    for name, text in files.items():
        (pack / name).parent.mkdir(exist_ok=True)
        (pack / name).write_text(text)


def fresh(monkeypatch):
    """As a new process would start."""
    for name in [name for name in sys.modules if name.startswith("my_policy")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    importlib.invalidate_caches()


@QUICK
@given(
    states=st.lists(st.tuples(GAINS, GAINS, st.sampled_from(["x", "y"])), max_size=3),
    unrelated=st.lists(st.text(alphabet="ab", max_size=2), min_size=3, max_size=3),
)
def test_of_a_module_with_its_package(tmp_path_factory, states, unrelated):
    import torch

    folder, hashes = tmp_path_factory.mktemp("pack"), []
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.syspath_prepend(str(folder))
        for state, text in zip(states, unrelated, strict=False):
            fresh(monkeypatch)
            write_package(folder, *state, text)
            loaded = load_any_policy("my_policy_pack.net:factory")
            hashes.append(loaded.sha256)
            steering_rad = loaded.policy(torch.full((1, 3, 8, 12), 0.5))
            assert float(steering_rad) == pytest.approx(0.5 * state[0] * state[1])
        fresh(monkeypatch)
    assert same_exactly_where_equal(states, hashes)


def test_a_module_that_was_edited_after_its_import_keeps_the_hash_of_its_code(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    fresh(monkeypatch)
    write_package(tmp_path, 1.0, 0.5, "", "")
    before = load_any_policy("my_policy_pack.net:factory").sha256
    write_package(tmp_path, 1.0, 2.0, "", "")
    assert load_any_policy("my_policy_pack.net:factory").sha256 == before  # what runs is the old code
    fresh(monkeypatch)
    assert load_any_policy("my_policy_pack.net:factory").sha256 != before
    fresh(monkeypatch)


READS = """
import json
import torch
from pathlib import Path
GAIN = json.loads(Path(__file__).with_name("gain.json").read_text())
def steer(images):
    noise = {noise} * torch.rand(len(images))
    return GAIN * (images.mean((1, 2, 3)) - 0.4) + noise
def factory():
    from advnerf_core import PolicyContract, PolicyView, adapt
    from advnerf_core.geometry import Pinhole
    view = PolicyView(Pinhole(12, 8, 6.0, 6.0, 6.0, 4.0), 0, 8, 12, 8)
    return adapt(steer, PolicyContract(view))
"""


def test_of_a_factory_whose_code_reads_a_file(tmp_path, monkeypatch):
    """No weight of it is known to torch; what it steers is."""
    monkeypatch.syspath_prepend(str(tmp_path))
    hashes = []
    for gain, noise in ((0.3, 0), (0.3, 0), (-0.3, 0), (0.302, 0), (0.3, 1), (-0.3, 1)):
        fresh(monkeypatch)
        (tmp_path / "my_policy_reads.py").write_text(READS.format(noise=noise))
        (tmp_path / "gain.json").write_text(str(gain))
        hashes.append(load_any_policy("my_policy_reads:factory").sha256)
    fresh(monkeypatch)
    assert hashes[0] == hashes[1]
    assert len(set(hashes[1:4])) == 3
    assert (
        hashes[4] == hashes[5] not in hashes[:4]
    )  # one that draws lots answers differently each time: its answers do not count


SERVED = """
import socket
import torch
class Asks(torch.nn.Module):
    identity = "a program at port {port}"
    def forward(self, images):
        with socket.create_connection(("127.0.0.1", {port}), timeout=600) as line:
            line.sendall(images.numpy().mean((1, 2, 3)).astype("<f4").tobytes() + b"end.")
            line.shutdown(socket.SHUT_WR)
            answer = line.makefile("rb").read()
        return torch.frombuffer(bytearray(answer), dtype=torch.float32)
def factory():
    from advnerf_core import PolicyContract, PolicyView, adapt
    from advnerf_core.geometry import Pinhole
    view = PolicyView(Pinhole(12, 8, 6.0, 6.0, 6.0, 4.0), 0, 8, 12, 8)
    return adapt(Asks().eval(), PolicyContract(view, differentiable=False))
"""


class Answering(socketserver.StreamRequestHandler):
    """Steers by a gain that may be changed while it runs, as a stranger's server is updated."""

    def handle(self):
        means = np.frombuffer(self.rfile.read()[:-4], "<f4")
        self.wfile.write((self.server.gain * means).astype("<f4").tobytes())


@pytest.mark.live
def test_a_policy_in_another_program_is_named_by_its_answers_and_is_not_fixed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    fresh(monkeypatch)
    with socketserver.TCPServer(("127.0.0.1", 0), Answering) as server:
        server.gain = 0.5
        threading.Thread(target=server.serve_forever, daemon=True).start()
        port = server.server_address[1]
        (tmp_path / "my_policy_asks.py").write_text(SERVED.format(port=port))
        loaded = load_any_policy("my_policy_asks:factory")
        assert loaded.metadata["not_fixed"] == f"a program at port {port}"
        assert load_driver("my_policy_asks:factory", loaded.sha256).steer(
            np.full((8, 12, 3), 204, np.uint8), ()
        ) == pytest.approx(0.4)
        server.gain = 0.6
        assert load_any_policy("my_policy_asks:factory").sha256 != loaded.sha256
        server.shutdown()
    fresh(monkeypatch)


def test_a_policy_that_runs_here_is_fixed(tmp_path):
    file = save_beside(mean_model({"steering": 0.25}), tmp_path / "policy.onnx")
    assert "not_fixed" not in load_any_policy(file).metadata


def test_the_hash_of_a_policy_that_is_not_loaded_covers_weights_and_declaration(tmp_path):
    def found(first, mean):
        return policy_file_sha256(write_onnx(tmp_path, first, 0.5, mean, "", "unrelated"))

    assert found(0.25, 0.0) == found(0.25, 0.0)
    assert len({found(0.25, 0.0), found(0.5, 0.0), found(0.25, 0.5)}) == 3
    other = tmp_path / "policy.safetensors"
    other.write_bytes(b"weights")
    assert policy_file_sha256(other) == sha256_of(other)
