import json

import pytest

from advnerf_core.files import write_atomically


def test_a_failed_write_leaves_the_old_file_and_no_other(tmp_path):
    target = tmp_path / "kept.json"
    write_atomically(target, json.dumps([1]))
    with pytest.raises(TypeError):
        write_atomically(target, 3)
    assert json.loads(target.read_text()) == [1]
    assert [p.name for p in tmp_path.iterdir()] == ["kept.json"]
