"""A pack whose storage fails one of its members before an iteration: that member is opened again, the others train."""

from pathlib import Path

import pytest
from fake_pack import Pack, results

from tests.narrowing import present
from tune_jobs.training.trial_steps import TrialSteps


@pytest.fixture
def failing(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The trials whose storage is away before their next iteration, once for each time that they are named."""
    names: list[str] = []
    before_iteration = TrialSteps.before_iteration

    def away(steps: TrialSteps, *, stop: bool) -> object:
        if steps.task.trial_id in names:
            names.remove(steps.task.trial_id)
            raise OSError("the storage is away")
        return before_iteration(steps, stop=stop)

    monkeypatch.setattr(TrialSteps, "before_iteration", away)
    return names


def test_a_storage_error_before_an_iteration_is_its_members_alone(tmp_path: Path, failing: list[str]) -> None:
    pack = Pack(tmp_path, max_retries=2, stop={"num_iterations": 5}).add("t0000", "t0001")
    pack.advance()
    failing.append("t0000")
    pack.advance()
    assert results(pack, "t0001") == [1, 2]
    pack.run()
    (failure,) = [report for report in pack.of("t0000") if report.error is not None]
    assert failure.retried
    assert present(failure.error).startswith("OSError: the storage is away")
    assert pack.engine.builds == [("t0000", None), ("t0001", None), ("t0000", 1)]
    for trial_id in ("t0000", "t0001"):
        assert (pack.last(trial_id).status, results(pack, trial_id)) == ("completed", [1, 2, 3, 4, 5])


def test_a_storage_error_of_all_members_trains_nobody_until_they_are_open_again(
    tmp_path: Path, failing: list[str]
) -> None:
    pack = Pack(tmp_path, max_retries=2, stop={"num_iterations": 3}).add("t0000", "t0001")
    failing += ["t0000", "t0001"]
    pack.advance()
    assert pack.engine.num_iterations == 0
    pack.run()
    assert [pack.last(trial_id).status for trial_id in ("t0000", "t0001")] == ["completed", "completed"]
    assert pack.engine.num_iterations == 3


def test_a_storage_error_that_stays_ends_the_member_alone(tmp_path: Path, failing: list[str]) -> None:
    pack = Pack(tmp_path, max_retries=2, stop={"num_iterations": 5}).add("t0000", "t0001")
    failing += ["t0000"] * 3
    pack.run()
    assert [report.retried for report in pack.of("t0000")] == [True, True, False]
    assert (pack.last("t0001").status, results(pack, "t0001")) == ("completed", [1, 2, 3, 4, 5])
