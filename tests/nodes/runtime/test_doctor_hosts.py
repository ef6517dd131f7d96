from nodes.runtime import doctor
from nodes.runtime.security import DRIVE, KeyFolder, default_folder


def test_keys_are_shown_and_one_that_others_may_read_is_a_finding_with_its_cure(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    assert "advnerf keys new" in doctor._keys().text
    keys = KeyFolder(default_folder())
    keys.new("robot")
    keys.allow("robot", DRIVE)
    assert doctor._keys() == doctor.Check("keys", doctor.OK, "ours: robot; robot may drive over the network")
    (tmp_path / "advnerf" / "keys" / "secret" / "robot.key").chmod(0o640)
    found = doctor._keys()
    assert found.state == doctor.WARNING
    assert "make a new key" in found.text


def test_clock_is_judged_by_what_the_kernel_says(monkeypatch):
    real = doctor._adjtimex_error_s()
    assert real is None or 0.0 <= real < 60.0
    for error_s, state in ((None, doctor.WARNING), (0.02, doctor.WARNING), (0.001, doctor.OK)):
        monkeypatch.setattr(doctor, "_adjtimex_error_s", lambda value=error_s: value)
        assert doctor._clock().state == state
