"""Finding a server: the real client library against real sockets where it can be, the scripted one for maps."""

import contextlib
import socket
import subprocess
import sys
import threading

import pytest

from hardware.worlds.carla.config import CarlaConfig, ServerConfig
from hardware.worlds.carla.connection import check_versions, connect, map_name, open_world
from hardware.worlds.carla.errors import CarlaMapError, CarlaUnreachable, CarlaVersionMismatch
from hardware.worlds.carla.scene import CarlaScene


@contextlib.contextmanager
def listening(answer):
    """A server on a real port that answers every request with ``answer(request)``; None says nothing."""

    def serve():
        while True:
            try:
                link, _ = listener.accept()
            except OSError:
                return
            threading.Thread(target=talk, args=(link,), daemon=True).start()

    def talk(link):
        with link, contextlib.suppress(OSError):
            while request := link.recv(65536):
                if (reply := answer(request)) is not None:
                    link.sendall(reply)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield listener.getsockname()[1]
        listener.shutdown(socket.SHUT_RDWR)
    thread.join()


def says_version(text):
    """MessagePack-RPC, as CARLA's server speaks it: [1, id, nil, [[1, text]]] for [0, id, "version", ...]."""

    def answer(request):
        assert b"\xa7version" in request
        return b"\x94\x01" + request[2:3] + b"\xc0\x91\x92\x01" + bytes([0xA0 + len(text)]) + text.encode()

    return answer


def test_no_server(carla):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with pytest.raises(
        CarlaUnreachable, match=rf"expected a CARLA server at 127.0.0.1:{port}, got: .*refused.*CarlaUE4.sh"
    ):
        CarlaScene(CarlaConfig(server=ServerConfig(port=port)), carla).__enter__()


def test_a_host_that_does_not_exist(carla):
    with pytest.raises(CarlaUnreachable, match=r"expected a CARLA server at nowhere.invalid:2000, got: "):
        connect(ServerConfig(host="nowhere.invalid"), carla)


def test_something_else_listens_there(carla):
    with (
        listening(lambda request: None) as port,
        pytest.raises(CarlaUnreachable, match=r"does not answer as one within 0.5 s"),
    ):
        connect(ServerConfig(port=port, timeout_s=0.5), carla)


def test_another_version_answers_the_real_client(carla):
    ours = carla.Client("127.0.0.1", 1).get_client_version()
    with (
        listening(says_version("0.9.13")) as port,
        pytest.raises(
            CarlaVersionMismatch, match=rf"expected CARLA {ours} at .*got 0.9.13.*pip install carla==0.9.13"
        ),
    ):
        connect(ServerConfig(port=port, timeout_s=5.0), carla)


def test_the_same_version_answers_the_real_client(carla):
    ours = carla.Client("127.0.0.1", 1).get_client_version()
    with listening(says_version(ours)) as port:
        assert connect(ServerConfig(port=port, timeout_s=5.0), carla).get_server_version() == ours


def test_what_a_build_adds_to_a_version_does_not_count():
    check_versions("0.9.16-dirty", "0.9.16", "here")
    with pytest.raises(CarlaVersionMismatch):
        check_versions("0.9.16", "0.9.15", "here")


def test_map_names():
    assert (
        map_name("/Game/Carla/Maps/Town02") == map_name("Carla/Maps/Town02") == map_name("Town02") == "Town02"
    )


def test_the_wanted_map_is_loaded_with_patience(library):
    library.maps = ["/Game/Carla/Maps/Town02", "/Game/Carla/Maps/Town01"]
    client = library.Client("127.0.0.1", 2000)
    open_world(client, ServerConfig(town="Town02", timeout_s=7.0, load_timeout_s=90.0))
    assert client.loaded == [("Town02", 90.0)]
    assert client.timeout_s == 7.0


@pytest.mark.parametrize("town", ["written", None])
def test_the_right_map_is_left_as_it_is(library, town):
    client = library.Client("127.0.0.1", 2000)
    assert open_world(client, ServerConfig(town=town)) is library.world
    assert client.loaded == []


def test_a_wrong_map(library):
    client = library.Client("127.0.0.1", 2000)
    with pytest.raises(CarlaMapError, match=r"expected the map Town02, got written; set server.load_town"):
        open_world(client, ServerConfig(town="Town02", load_town=False))
    with pytest.raises(CarlaMapError, match=r"expected the map Town99 on the server, which has written"):
        open_world(client, ServerConfig(town="Town99"))


def test_without_the_library_importing_works_and_using_says_what_to_install():
    """In a Python of its own that cannot import carla."""
    program = (
        "import sys; sys.modules['carla'] = None\n"
        "from hardware.worlds import CarlaConfig, CarlaScene\n"
        "from hardware.worlds.carla.errors import CarlaNotInstalled\n"
        "try:\n    CarlaScene().__enter__()\n"
        "except CarlaNotInstalled as error:\n    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=600)
    assert "pip install 'advnerf[carla]'" in done.stdout, done.stderr
