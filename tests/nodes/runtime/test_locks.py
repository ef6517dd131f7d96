"""Locks of a whole machine are shared by its users."""

import os
import subprocess

import pytest

from nodes.runtime.locks import HeldError, hold, hold_folder

STRANGER = 4242


def test_a_lock_names_its_owner_and_ends_with_its_file(tmp_path):
    with hold(tmp_path / "lock"):
        with pytest.raises(HeldError) as held:
            hold(tmp_path / "lock")
        assert held.value.owner == str(os.getpid())
    hold(tmp_path / "lock").close()


def fail_in(folder, is_used):
    with hold_folder(folder):
        if is_used:
            (folder / "work").touch()
        (folder / "input").read_bytes()


def test_a_new_folder_with_nothing_but_its_lock_goes_with_the_error(tmp_path):
    (tmp_path / "there").mkdir()
    for name in ("there", "new", "used"):
        with pytest.raises(FileNotFoundError):
            fail_in(tmp_path / name, name == "used")
    assert sorted(each.name for each in tmp_path.iterdir()) == ["there", "used"]


@pytest.mark.skipif(os.getuid() != 0, reason="only root can act as another user")
def test_a_file_that_another_user_made_can_be_locked(open_folder):
    file = open_folder / "lock"
    hold(file).close()
    os.chmod(file, 0o644)
    pid = os.fork()
    if pid == 0:  # the stranger
        code = 9
        try:
            os.setgroups([])
            os.setgid(STRANGER)
            os.setuid(STRANGER)
            assert not os.access(file, os.W_OK)
            with hold(file):
                done = subprocess.run(["flock", "--nonblock", str(file), "true"], check=False)
            code = 0 if done.returncode else 1
        finally:
            os._exit(code)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
    hold(file).close()
