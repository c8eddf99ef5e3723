"""The examination of an installation."""

import pytest

from netdesign.doctor import Check, Examination, _release, doctor


def test_this_installation_is_in_order():
    examination = doctor()
    assert examination.problem is None, examination.text
    names = [check.name for check in examination.checks]
    assert {"numpy", "gtsam", "pin", "drawing without a display", "conventions (pyrender)"} <= set(names)
    assert examination.record["good"] is True
    assert len(examination.text.splitlines()) == len(names)


def test_the_first_failure_becomes_the_problem_with_status_4():
    checks = (
        Check(name="python", good=True, found="3.11"),
        Check(name="drawing", good=False, found="no EGL", advice="apt-get install libegl1"),
        Check(name="numba", good=False, found="not installed"),
    )
    examination = Examination(checks=checks)
    assert str(examination.problem) == "drawing: no EGL; apt-get install libegl1"
    assert examination.problem.exit_status == 4
    assert examination.record["good"] is False
    assert "FAIL drawing" in examination.text


@pytest.mark.parametrize(
    ("version", "release"),
    [("4.3.0", (4, 3, 0)), ("0.1.11.post3", (0, 1, 11)), ("2.0rc1", (2, 0)), ("1.2+local3", (1, 2))],
)
def test_release_numbers(version, release):
    assert _release(version)[: len(release)] == release
