"""Files of people have one reader for each format, which is strict. Nothing else in the project parses YAML, JSON or CSV, except what is listed here."""

import ast
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("advnerf_core", "hardware", "calibration", "nodes", "benchmarks", "docs", "examples")
LEAVES = ("advnerf_core/documents.py", "advnerf_core/csv_rows.py")
PARSERS = {
    "json": {"load", "loads", "JSONDecoder"},
    "csv": {"reader", "DictReader"},
    "yaml": None,  # every name: what it writes must be read as version 1.2, too
    "tomllib": None,
    "configparser": None,
}
METHODS = {"model_validate_json", "validate_json"}
# JSON that no person writes: number of calls by file.
WIRE = {
    "hardware/worlds/remote.py": 1,  # replies of a world's server
    "hardware/worlds/servers/serve.py": 1,  # runs in the server's own environment
    "calibration/colmap_messages.py": 2,  # lines of our COLMAP process
    "nodes/experiment/run/worker.py": 1,  # a job on standard input
    "nodes/experiment/node/job.py": 1,  # lines of a search process
    "nodes/lab/doctor/check.py": 1,  # a probe's answer
    "nodes/lab/doctor/priority.py": 1,  # a child's answer
    "nodes/lab/doctor/probes.py": 1,  # a probe's arguments
    "nodes/operator_page/said.py": 2,  # messages of the page
    "benchmarks/adjoint_memory.py": 1,  # output of a child
    "benchmarks/baked_scene.py": 2,
    "benchmarks/lockstep_replay.py": 1,
    "benchmarks/rclpy_peer.py": 1,
    "benchmarks/rclpy_peers/zenoh_answering.py": 1,  # type definitions from a test
    "benchmarks/seeds_together.py": 1,
}
HEADERS = {  # text in the header of a tensor file or archive that our own writer made
    "advnerf_core/attack/artifact.py": 2,
    "advnerf_core/attack/search/search.py": 1,
    "advnerf_core/attack/search/together.py": 1,
    "advnerf_core/files.py": 1,
    "advnerf_core/objects/voxel/model.py": 1,
    "advnerf_core/policies/exported_policy.py": 1,
    "advnerf_core/policies/policy_file.py": 3,
    "advnerf_core/scene/baked.py": 3,
    "advnerf_core/scene/field.py": 3,
    "advnerf_core/scene/train.py": 1,
    "advnerf_core/splats/scene_file.py": 2,
    "nodes/experiment/node/worker.py": 2,
    "nodes/experiment_page/searches.py": 1,
    "nodes/operator_page/pictures.py": 1,
}
OWN = {  # text that the same function has just written, or already read as a whole
    "advnerf_core/learning/retrain.py": 1,
    "advnerf_core/report/evidence/verifying/numbers.py": 1,
    "nodes/experiment/run/published.py": 1,
    "nodes/experiment/show/experiment_world.py": 1,
    "nodes/experiment/engine/artefact.py": 1,
    "nodes/lab/trials/plan.py": 1,
    "nodes/lab/worlds/check.py": 2,
    "hardware/cameras/zed/calibration.py": 2,  # the INI file of the camera's maker; configparser refuses a key given twice
    "nodes/bags/metadata.py": 2,  # writes rosbag2's metadata in the style of rosbag2
}


def parsers_in(text):
    """Names of the parsers that a Python text uses."""
    tree = ast.parse(text)
    modules, found = {}, []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            modules |= {name.asname or name.name: name.name for name in node.names if name.name in PARSERS}
        elif isinstance(node, ast.ImportFrom) and node.module in PARSERS:
            found += [f"{node.module}.{name.name}" for name in node.names]
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            module = modules.get(node.value.id) if isinstance(node.value, ast.Name) else None
            if node.attr in METHODS:
                found.append(node.attr)
            elif module and (PARSERS[module] is None or node.attr in PARSERS[module]):
                found.append(f"{module}.{node.attr}")
    return found


def test_only_the_listed_files_parse_text_themselves():
    files = [file for folder in FOLDERS for file in (ROOT / folder).rglob("*.py")]
    used = {str(file.relative_to(ROOT)): parsers_in(file.read_text(encoding="utf-8")) for file in files}
    counts = Counter({name: len(found) for name, found in used.items() if found and name not in LEAVES})
    assert all(used[leaf] for leaf in LEAVES)
    assert dict(counts) == WIRE | HEADERS | OWN, (
        "read files with advnerf_core.documents or advnerf_core.csv_rows"
    )


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("import json\njson.loads('1')\njson.dumps(1)", ["json.loads"]),
        ("import yaml as y\ny.safe_load('1')", ["yaml.safe_load"]),
        ("from csv import DictReader", ["csv.DictReader"]),
        ("def f(m):\n    import json\n    return json.load(m), m.model_validate_json('1')", ["json.load", "model_validate_json"]),
        ("a.yaml.exists()\nself.json.loads", []),
    ],
)  # fmt: skip
def test_a_parser_is_found_however_it_is_imported(text, found):
    assert sorted(parsers_in(text)) == sorted(found)
