"""The table of score against target: what passes, what is a miss, and what is run at all."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from policies.errors import EnvError
from tests.learning import __main__ as command
from tests.learning.measure import Measurement, SeedResult, misses, owns_up, verdict
from tests.learning.table import HEADINGS, markdown, row
from tests.learning.targets import TARGETS, Target, Task, tasks
from tests.narrowing import present
from tune_jobs.spec.file import read_preset


def seed(
    score: float,
    *,
    steps: int = 50_000,
    solve: int | None = 20_000,
    returns: Sequence[float] | tuple[Any, ...] = (),
    random: float = 20.0,
) -> SeedResult:
    return SeedResult("t0000", score, tuple(returns), random, steps, steps, solve, 1.0)


def measured(*seeds: SeedResult, preset: str = "cartpole-dqn-replay", num_failed: int = 0) -> Measurement:
    return Measurement(preset, seeds, num_failed, 60.0)


def task(preset: str = "cartpole-dqn-replay", target: Target | None = None) -> Task:
    target = target or TARGETS[preset]
    return Task(preset, target, target)


def test_the_median_over_the_seeds_decides() -> None:
    target = Target("why", score=195)
    lucky = measured(seed(200.0), seed(100.0), seed(196.0), seed(9.0), seed(195.0))
    assert lucky.score == 195.0
    assert misses(target, lucky) == []
    assert misses(target, measured(seed(200.0), seed(194.9), seed(9.0))) == ["score 194.9 < 195"]


def test_a_failed_seed_is_a_miss_and_so_are_no_seeds() -> None:
    target = Target("why", score=195)
    assert misses(target, measured(seed(200.0), num_failed=1)) == ["1 trials failed"]
    assert misses(target, measured(num_failed=5)) == ["every trial failed"]


def test_no_seed_may_take_more_env_steps() -> None:
    target = Target("why", score=500, max_env_steps=60_000)
    assert misses(target, measured(seed(500.0, steps=60_000), seed(500.0, steps=100))) == []
    assert misses(target, measured(seed(500.0, steps=60_001), seed(500.0), seed(500.0))) == [
        "60,001 env steps > 60,000"
    ]


def test_solving_within_is_strict_and_about_the_median() -> None:
    target = Target("why", solve_within=140_000)
    assert misses(target, measured(seed(1.0, solve=139_999), seed(1.0, solve=None), seed(1.0, solve=5))) == []
    assert misses(target, measured(seed(1.0, solve=140_000))) == ["solved after 140,000, not within 140,000 env steps"]
    assert misses(target, measured(seed(1.0, solve=None)))[0].startswith("never solved in training")


def test_full_episodes_are_counted_among_the_first() -> None:
    target = TARGETS["cartpole-dqn-keras"]
    good = [500.0] * 19 + [499.0] + [500.0] * 80
    assert misses(target, measured(seed(490.0, returns=good))) == []
    # Whatever comes after the first 20 does not count.
    poor = [500.0] * 18 + [499.0] * 2 + [500.0] * 80
    assert misses(target, measured(seed(490.0, returns=poor))) == ["18 of 20 episodes at 500 < 19"]
    assert len(misses(target, measured(seed(400.0, returns=poor)))) == 2


def test_falling_short_of_random_play_passes_only_where_the_preset_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    last = task("cartpole-dql-last")
    found = measured(seed(59.0), preset="cartpole-dql-last")
    assert misses(present(last.target), measured(seed(60.0))) == []
    assert misses(present(last.target), found) == ["2.95 x random play < 3 x"]
    for words, fine in (("It does not beat random play.", True), ("It beats random play.", False)):
        monkeypatch.setattr(
            "tests.learning.measure.find_preset",
            lambda name, words=words: read_preset(name, f"about: {{title: T, shows: {words}}}\n"),
        )
        passed, word = verdict(last, found)
        assert passed is fine
        assert word.startswith("honest" if fine else "MISS")
        assert verdict(last, dataclasses.replace(found, num_failed=1))[0] is False


@pytest.mark.parametrize(
    ("words", "fine"),
    [
        ("is no better than random play", True),
        ("hardly better, on average, than random", True),
        ("beats random play by 3x", False),
        ("not solved. It beats random play", False),
    ],
)
def test_what_owning_up_means(words: str, fine: bool) -> None:
    assert owns_up(read_preset("x", f"about:\n  title: T\n  description: More {words}\n")) is fine


def test_the_target_is_the_fixed_siblings_and_the_plain_one_is_measured_beside_it() -> None:
    found, skipped = tasks({"cartpole-dqn-keras", "cartpole-dqn-keras-fixed", "acrobot-ppo", "own"})
    assert [(item.preset, item.target is None) for item in found] == [
        ("cartpole-dqn-keras", True),
        ("cartpole-dqn-keras-fixed", False),
        ("acrobot-ppo", False),
    ]
    assert found[0].shown_target == found[1].target == TARGETS["cartpole-dqn-keras"]
    assert set(skipped) == set(TARGETS) - {"cartpole-dqn-keras", "acrobot-ppo"}
    assert verdict(found[0], measured(seed(1.0, returns=[1.0] * 100))) == (
        True,
        "measured; the target is cartpole-dqn-keras-fixed's",
    )


def test_wanted_presets_alone_are_run_and_unknown_ones_named() -> None:
    found, skipped = tasks({"acrobot-ppo", "pendulum-ppo"}, ("pendulum-ppo", "acrobot-dqn"))
    assert [item.preset for item in found] == ["pendulum-ppo"]
    assert list(skipped) == ["acrobot-dqn"]
    with pytest.raises(ValueError, match="no target for acrobat"):
        tasks({"acrobot-ppo"}, ("acrobat",))


def test_every_target_has_a_reason_and_something_to_reach() -> None:
    for name, target in TARGETS.items():
        assert len(target.reason) > 10, name
        assert misses(target, measured(seed(-1e9, steps=10**9, solve=None, returns=[-1.0] * 100))), name


def test_a_row_tells_all_of_a_preset() -> None:
    cells = row(
        task("cartpole-ppo-single"),
        measured(seed(200.0, solve=30_000), seed(190.0, solve=None), seed(198.0, solve=9_000, steps=40_000)),
    )
    assert dict(zip(HEADINGS, cells, strict=True)) == {
        "preset": "cartpole-ppo-single",
        "target": "195, solved before 140,000",
        "score": "198.0",
        "score of each seed": "200.0, 190.0, 198.0",
        "env steps": "40,000 to 50,000",
        "env steps to solve": "30,000",
        "time": "1 min 0 s",
        "result": "pass",
    }
    assert row(task(), None)[-1] == "skipped"
    assert markdown([cells]).splitlines()[2].startswith("| cartpole-ppo-single | 195, solved before 140,000 | 198.0 |")


def run(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, answers: dict[str, EnvError | Measurement], *arguments: str
) -> int:
    """The command with measurements by preset, exceptions raised."""

    def fake(task: Task, num_seeds: int, storage: Path) -> Measurement:
        answer = answers[task.preset]
        if isinstance(answer, Exception):
            raise answer
        return dataclasses.replace(answer, preset=task.preset)

    monkeypatch.setattr(command, "measure", fake)
    presets = [read_preset(name, "about: {title: T}\n") for name in answers]
    monkeypatch.setattr(command, "list_presets", lambda: presets)
    return command.main([*arguments, "--json", str(tmp_path / "out.json")])


def test_the_exit_code_tells_a_miss(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good, bad = measured(seed(200.0)), measured(seed(100.0))
    assert run(monkeypatch, tmp_path, {"cartpole-dqn-replay": good}) == 0
    assert "cartpole-dql-last: skipped, there is no preset of this name" in capsys.readouterr().out
    assert run(monkeypatch, tmp_path, {"cartpole-dqn-replay": good, "cartpole-dql-replay": bad}) == 1
    assert "MISS: score 100.0 < 195" in capsys.readouterr().out
    documents = json.loads((tmp_path / "out.json").read_text())
    assert [(item["preset"], item["passed"]) for item in documents] == [
        ("cartpole-dqn-replay", True),
        ("cartpole-dql-replay", False),
    ]
    assert documents[0]["seeds"][0]["score"] == 200.0


def test_a_missing_package_skips_and_a_wrong_preset_does_not(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    missing = EnvError("LunarLander needs Box2D.", "Install it: pip install Box2D==2.3.10")
    assert run(monkeypatch, tmp_path, {"lunarlander-ppo": missing}) == 0
    assert "lunarlander-ppo: skipped, it cannot run here: LunarLander needs Box2D." in capsys.readouterr().out
    assert json.loads((tmp_path / "out.json").read_text())[0]["skipped"].startswith("LunarLander needs Box2D.")
    with pytest.raises(EnvError):
        run(monkeypatch, tmp_path, {"lunarlander-ppo": EnvError("No such argument.", "It takes: x.")})


def test_bad_options_are_exit_code_2(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, tmp_path, {}, "--preset", "nope") == 2
    assert "no target for nope" in capsys.readouterr().err
    with pytest.raises(SystemExit) as caught:
        command.main(["--seeds", "0"])
    assert caught.value.code == 2
