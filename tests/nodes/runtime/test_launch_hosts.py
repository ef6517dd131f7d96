import pytest

from nodes.launching.launch_file import load_launch
from nodes.runtime.errors import ConfigError

pytestmark = pytest.mark.live

FILE = """
name: pair
hosts:
  robot: {address: 192.168.7.2}
  workstation: {}
keys: ~/keys
record: true
nodes:
  camera: {module: nodes.camera, host: robot}
  vicon: {module: nodes.vicon, host: robot}
  safety: {module: nodes.safety, host: robot}
  motor: {module: nodes.motor, host: robot}
  compositor: {module: nodes.compositor, host: workstation}
  policy: {module: nodes.policy, host: workstation}
"""


@pytest.fixture
def launch_file(tmp_path):
    def write(text=FILE):
        (tmp_path / "pair.launch.yaml").write_text(text)
        return tmp_path / "pair.launch.yaml"

    return write


def gateway(file, host):
    plan = load_launch(file, host=host)
    return set(plan.nodes), plan.documents["gateway"].data


def test_each_host_runs_its_nodes_and_a_gateway_whose_lists_mirror_the_other(launch_file):
    file = launch_file()
    on_robot, robot = gateway(file, "robot")
    on_workstation, workstation = gateway(file, "workstation")
    assert on_robot == {"camera", "vicon", "safety", "motor", "gateway"}
    assert on_workstation == {"compositor", "policy", "recorder", "gateway"}
    assert set(robot["exports"]) == set(workstation["imports"])
    assert set(robot["imports"]) == set(workstation["exports"])
    assert not set(robot["exports"]) & set(robot["imports"])
    assert {"/camera/image_raw", "/safety/state", "/status/motor", "/clock/offset"} <= set(robot["exports"])
    assert {"/policy/drive", "/arm", "/status/policy"} <= set(robot["imports"])
    assert robot["listen"] == workstation["connect"] == "192.168.7.2"
    assert (robot["key"], workstation["key"], workstation["peer_key"]) == ("robot", "workstation", "robot")


def test_all_runs_everything_here_without_a_gateway(launch_file):
    assert set(load_launch(launch_file(), host="all").nodes) == {
        "camera",
        "vicon",
        "safety",
        "motor",
        "compositor",
        "policy",
        "recorder",
    }


@pytest.mark.parametrize(
    ("change", "peers"),
    [
        (("", ""), ["workstation"]),
        (("workstation: {}", "workstation: {key: desk}"), ["desk"]),
        (("nodes.safety, host: robot", "nodes.safety, host: robot, config: {clock_peers: []}"), []),
        # Nothing that moves the car comes from there: it may drive without the workstation.
        (("nodes.policy, host: workstation", "nodes.policy, host: robot"), None),
    ],
)
def test_commands_from_the_other_host_need_its_clock_to_be_known(launch_file, change, peers):
    plan = load_launch(launch_file(FILE.replace(*change)), host="robot")
    assert plan.documents["safety"].data.get("clock_peers") == peers


def test_all_on_one_host_has_one_clock(launch_file):
    assert "clock_peers" not in load_launch(launch_file(), host="all").documents["safety"].data


def test_people_may_be_at_the_car(launch_file):
    _, robot = gateway(launch_file(FILE + "operator: robot\n"), "robot")
    assert "/arm" in robot["exports"]


PAGE = "  page: {module: nodes.page, host: HOST, config: {role: ROLE}}\n"


def with_pages(*pages, operator="workstation"):
    added = "".join(
        PAGE.replace("page:", f"page_{host}:").replace("HOST", host).replace("ROLE", role)
        for host, role in pages
    )
    return f"{FILE}{added}operator: {operator}\n"


@pytest.mark.parametrize(
    ("pages", "operator", "source"),
    [
        ([], "workstation", "workstation"),
        ([], "robot", "robot"),
        ([("workstation", "operate")], "workstation", "workstation"),
        ([("robot", "operate")], "workstation", "robot"),
        ([("robot", "operate"), ("workstation", "watch")], "workstation", "robot"),
    ],
)
def test_the_button_and_the_e_stop_reach_the_car_from_where_people_operate(
    launch_file, pages, operator, source
):
    file = launch_file(with_pages(*pages, operator=operator))
    robot, workstation = gateway(file, "robot")[1], gateway(file, "workstation")[1]
    from_, to = (robot, workstation) if source == "robot" else (workstation, robot)
    assert "/teleop/state" in from_["exports"]
    assert "/teleop/state" in to["imports"]


@pytest.mark.parametrize(
    ("pages", "operator", "words"),
    [
        (
            [("workstation", "operate")],
            "robot",
            "expected the page page_workstation on robot, .* set operator: workstation",
        ),
        (
            [("robot", "operate"), ("workstation", "operate")],
            "workstation",
            "expected one operator page, got",
        ),
    ],
)
def test_a_page_whose_e_stop_would_not_reach_the_car_is_refused(launch_file, pages, operator, words):
    with pytest.raises(ConfigError, match=words):
        load_launch(launch_file(with_pages(*pages, operator=operator)), host="robot")


def test_topics_that_ros2_supplies_come_from_its_host(launch_file):
    taken = "{take: [{topic: /vicon/car, name: /pose, type: geometry_msgs/msg/PoseStamped}]}"
    text = FILE.replace(
        "  vicon: {module: nodes.vicon, host: robot}",
        f"  ros2: {{module: nodes.ros2, host: workstation, config: {taken}}}",
    )
    file = launch_file(text)
    assert "/vicon/car" in gateway(file, "workstation")[1]["exports"]
    assert "/vicon/car" in gateway(file, "robot")[1]["imports"]


@pytest.mark.parametrize(
    ("change", "host", "words"),
    [
        (("", ""), None, "expected --host with one of robot, workstation, or all; got None"),
        (("", ""), "laptop", "with one of robot, workstation, or all; got laptop"),
        (("workstation: {}", "workstation: {address: 10.0.0.3}"), "robot", "one of them with an address"),
        (
            ("{module: nodes.policy, host: workstation}", "{module: nodes.policy}"),
            "robot",
            "node policy needs a host",
        ),
        (
            ("{module: nodes.motor, host: robot}", "{module: nodes.motor, host: workstation}"),
            "robot",
            "no network lies between",
        ),
        (("workstation: {}", "workstation: {port: 1}"), "robot", "unknown key hosts.workstation.port"),
    ],
)
def test_wrong_hosts_are_one_error(launch_file, change, host, words):
    with pytest.raises(ConfigError, match=words):
        load_launch(launch_file(FILE.replace(*change)), host=host)


def test_host_of_a_file_without_hosts(launch_file):
    plain = "name: plain\nnodes: {vicon: {module: nodes.vicon}}\n"
    assert "gateway" not in load_launch(launch_file(plain)).nodes
    with pytest.raises(ConfigError, match="has no hosts"):
        load_launch(launch_file(plain), host="robot")


def test_set_reaches_a_nodes_own_key_host(launch_file):
    plain = launch_file("name: plain\nnodes: {vicon: {module: nodes.vicon}}\n")
    assert load_launch(plain, ["vicon.host=0.0.0.0"]).documents["vicon"].data["host"] == "0.0.0.0"
    pair = launch_file()
    plan = load_launch(pair, ["vicon.config.host=0.0.0.0"], host="robot")
    assert plan.documents["vicon"].data["host"] == "0.0.0.0"
    assert "vicon" in load_launch(pair, ["vicon.host=workstation"], host="workstation").nodes
    with pytest.raises(
        ConfigError, match=r"one of robot, workstation; got 0\.0\.0\.0\. .* own key, use vicon\.config\.host"
    ):
        load_launch(pair, ["vicon.host=0.0.0.0"], host="robot")


WATCHED = """
name: pair
operator: robot
hosts:
  robot: {address: 127.0.0.1}
  desk: {}
nodes:
  camera: {module: nodes.camera, host: robot}
  policy: {module: nodes.policy, host: robot}
  safety: {module: nodes.safety, host: robot}
  motor: {module: nodes.motor, host: robot}
  viewer: {module: nodes.viewer, host: desk}
"""


def test_without_keys_the_other_host_can_only_watch(launch_file):
    file = launch_file(WATCHED)
    robot, desk = gateway(file, "robot")[1], gateway(file, "desk")[1]
    assert robot["imports"] == desk["exports"] == []
    assert {"/camera/image_raw", "/safety/state", "/arm"} <= set(robot["exports"]) == set(desk["imports"])
    with_keys = gateway(launch_file(WATCHED + "keys: k\n"), "robot")[1]
    assert with_keys["imports"] == ["/status/viewer"]


@pytest.mark.parametrize("host", ["robot", "desk"])
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("operator: robot\n", ""), "without keys .* robot would accept .*/arm"),
        (("nodes.policy, host: robot", "nodes.policy, host: desk"), "robot would accept /policy/drive"),
    ],
)
def test_without_keys_nobody_commands_from_the_other_host(launch_file, change, words, host):
    with pytest.raises(ConfigError, match=words):
        load_launch(launch_file(WATCHED.replace(*change)), host=host)
