"""A sweep in other forms: data frames, files of them, a LaTeX table, an Optuna study."""

import dataclasses
import importlib.util
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from sweep_folders import make_sweep_folder
from synthetic_sweep import make_sweep

import tune_jobs
from analysis.exports.frames import ROWS, SweepData, flat, make_frame, settings_frame
from analysis.exports.latex import escaped, latex_table
from analysis.records import IterationRecord, TrialRecord
from policies.errors import CannotRunError, SpecError
from tune_jobs.cli.result_commands import FORMATS as OFFERED
from tune_jobs.search.study import make_study
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.sweeps.exports import FORMATS

ROOT = Path(__file__).parents[2]
SPACE = {
    "hidden_sizes": {"grid": [[32], [64]]},
    "activation": {"grid": ["linear", "relu"]},
    "lr": {"uniform": [1e-7, 1e-2]},
}


def data_of(**given: Any) -> SweepData:
    made = make_sweep(**given)
    return SweepData(made.trials, made.results, "final", num_env_steps=50_000, threshold=195.0)


@pytest.fixture(scope="module")
def data() -> SweepData:
    return data_of(seeds_per_point=2, failed={3}, pending={5})


def iteration(number: int, evaluation: float | None, *, training: float | None = None) -> IterationRecord:
    return IterationRecord(
        iteration=number, num_env_steps=100 * number, num_episodes=10, time_s=1.0, evaluation_return=evaluation,
        training_return=training,
    )  # fmt: skip


def trial(index: int, point: dict[str, Any] | None = None, **given: Any) -> TrialRecord:
    values: dict[str, Any] = {"status": "completed", "point_index": index, **given}
    return TrialRecord(trial_id=f"t{index:04d}", index=index, seed=index, point=point or {"lr": 0.1}, **values)


# -- tables


def test_every_column_of_every_table_is_in_the_guide(data: SweepData) -> None:
    guide = (ROOT / "docs" / "guides" / "exports.md").read_text()
    for rows in ROWS:
        section = guide.split(f"\n### {rows}\n")[1].split("\n#")[0]
        first_cells = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
        told = {name for cell in first_cells for name in re.findall(r"`([^`]+)`", cell)}
        columns = set(make_frame(data, rows).columns) - {"hidden_sizes", "activation", "lr"}
        columns = {"learner/..." if name.startswith("learner/") else name for name in columns}
        assert columns == told - {"changes"}, rows


def test_evaluations_are_the_iterations_that_were_evaluated(data: SweepData) -> None:
    frame = make_frame(data, "evaluations")
    iterations = make_frame(data, "iterations")
    assert len(frame) == iterations["evaluation_return"].notna().sum() > 0
    both = frame.merge(iterations, on=["trial_id", "iteration"], suffixes=("", "_too"))
    assert len(both) == len(frame)
    assert (both["evaluation_return"] == both["evaluation_return_too"]).all()
    kept = frame[frame["has_checkpoint"]]
    assert set(zip(kept["trial_id"], kept["iteration"], strict=True)) == {
        (item.trial_id, item.iteration)
        for each in data.trials
        for item in each.checkpoints
        if item.evaluation_return is not None
    }


def test_a_setting_is_a_row_with_its_seeds_failures_and_interval(data: SweepData) -> None:
    frame = settings_frame(data)
    assert frame["rank"].tolist() == list(range(1, len(frame) + 1))
    assert frame["expected"].is_monotonic_decreasing
    by_point = frame.set_index("point_index")
    # t0003 failed, which is a seed of point 1; t0005 has not run, so that point 2 has one seed.
    assert by_point.loc[1, "num_failed"] == 1
    assert by_point.loc[2, "num_seeds"] == 1
    assert (frame["lower"] < frame["mean"]).all()
    assert (frame["mean"] < frame["upper"]).all()
    assert frame["probability_best"].sum() == pytest.approx(1.0)
    assert bool(frame["may_be_best"].iloc[0])


def test_the_interval_of_a_single_setting_is_students(data: SweepData) -> None:
    only = [item for item in data.trials if item.point_index == 0]
    more = [item.model_copy(update={"trial_id": f"t{20 + i:04d}", "index": 20 + i}) for i, item in enumerate(only)]
    results = {**data.results, "t0020": data.results["t0010"], "t0021": data.results["t0012"]}
    ours = dataclasses.replace(data, trials=[*only, *more], results=results)
    scores = make_frame(ours, "trials")["objective_score"].to_numpy()
    (row,) = settings_frame(ours).to_dict("records")
    assert len(set(scores)) == 4
    expected = stats.t.interval(0.95, 3, loc=scores.mean(), scale=stats.sem(scores))
    np.testing.assert_allclose([row["lower"], row["upper"]], expected, rtol=1e-9)
    assert row["iqm"] == pytest.approx(stats.trim_mean(scores, 0.25))


def test_with_one_seed_a_setting_nothing_is_said_of_certainty() -> None:
    frame = settings_frame(data_of())
    assert len(frame) == 20
    assert frame[["lower", "upper", "probability_best", "may_be_best"]].isna().all(axis=None)


def test_without_trials_and_in_a_population_there_are_empty_tables(data: SweepData) -> None:
    nothing = SweepData([], {}, "final", num_env_steps=1, threshold=None)
    for rows in ROWS:
        assert make_frame(nothing, rows).empty
    population = dataclasses.replace(data, has_settings=False)
    assert settings_frame(population).empty
    assert make_frame(population, "trials")["objective_score"].isna().all()


def test_all_failed_is_a_table_of_failures_and_no_settings() -> None:
    failed = data_of(failed=range(20))
    assert set(make_frame(failed, "trials")["status"]) == {"failed"}
    assert make_frame(failed, "trials")["objective_score"].isna().all()
    assert settings_frame(failed).empty


def test_scores_beyond_all_squares_have_no_interval() -> None:
    huge = [trial(i, point_index=0, seed_index=i) for i in range(2)]
    results = {"t0000": [iteration(1, 1e300)], "t0001": [iteration(1, -1e300)]}
    frame = settings_frame(SweepData(huge, results, "final", num_env_steps=100, threshold=None))
    assert frame["lower"].isna().all()


def test_steps_to_the_threshold_are_known_where_trials_end_before_their_training_return_reaches_it() -> None:
    """A trial that `stop.evaluation_return` ends has not played 100 episodes at that level yet."""
    results = {"t0000": [iteration(1, 3.0, training=1.0), iteration(2, 9.0, training=2.0)], "t0001": []}
    frame = make_frame(
        SweepData([trial(0), trial(1)], results, "final", num_env_steps=200, threshold=9.0), "trials"
    ).set_index("trial_id")
    assert frame["num_env_steps_to_solve"].isna().all()
    assert frame.loc["t0000", "num_env_steps_to_threshold"] == 200
    assert frame["num_env_steps_to_threshold"].isna().tolist() == [False, True]


def test_the_objectives_own_threshold_counts_first(tmp_path: Path) -> None:
    make_sweep_folder(tmp_path / "own", objective={"type": "final", "threshold": 4.0})
    make_sweep_folder(tmp_path / "envs")
    own = tune_jobs.dataframe("own", storage=tmp_path)["num_env_steps_to_threshold"]
    assert own.notna().all()
    # The evaluations go up to 36, and CartPole-v1 is solved at 475.
    assert tune_jobs.dataframe("envs", storage=tmp_path)["num_env_steps_to_threshold"].isna().all()


# -- files


@pytest.mark.parametrize(("kind", "read"), [("csv", pd.read_csv), ("parquet", pd.read_parquet)])
def test_tables_are_read_again_as_they_were(tmp_path: Path, kind: Any, read: Callable[[Path], pd.DataFrame]) -> None:
    make_sweep_folder(tmp_path / "mine")
    paths = tune_jobs.export("mine", kind, output=tmp_path / "out", storage=tmp_path)
    assert list(paths) == list(ROWS)
    for rows in ROWS:
        assert paths[rows] == tmp_path / "out" / f"{rows}.{kind}"
        frame = tune_jobs.dataframe("mine", rows, storage=tmp_path)
        found = read(paths[rows])
        assert list(found.columns) == list(frame.columns)
        assert len(found) == len(frame) > 0
        for name in ("num_env_steps", "mean", "lr"):
            if name in frame:
                assert found[name].tolist() == frame[name].tolist()


def test_a_column_of_mixed_values_becomes_text_for_parquet(tmp_path: Path) -> None:
    points: list[dict[str, Any]] = [{"lr_final": None}, {"lr_final": 0.5}, {"lr_final": "auto"}, {"lr_final": True}]
    mixed = [trial(index, point) for index, point in enumerate(points)]
    frame = make_frame(SweepData(mixed, {}, "final", num_env_steps=1, threshold=None), "trials")
    with pytest.raises(Exception, match=r"(?i)convert|expected|bytes"):
        frame.to_parquet(tmp_path / "not.parquet")
    flat(frame).to_parquet(tmp_path / "flat.parquet")
    found = pd.read_parquet(tmp_path / "flat.parquet")["lr_final"]
    assert found.tolist()[1:] == ["0.5", "auto", "True"]
    assert pd.isna(found[0])


def test_the_command_offers_the_formats_there_are() -> None:
    assert OFFERED == FORMATS


def test_a_suffix_is_added_and_a_folder_for_tables_is_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_sweep_folder(tmp_path / "mine")
    monkeypatch.chdir(tmp_path)
    assert tune_jobs.export("mine", "latex", storage=tmp_path) == {"table": Path("mine.tex")}
    assert tune_jobs.export(tmp_path / "mine", "latex", output="v1.2") == {"table": Path("v1.2.tex")}
    with pytest.raises(CannotRunError, match="is a file"):
        tune_jobs.export("mine", "csv", output="mine.tex", storage=tmp_path)


def test_without_a_format_the_suffix_says_it(tmp_path: Path) -> None:
    make_sweep_folder(tmp_path / "mine")
    for kind, read in (("csv", pd.read_csv), ("parquet", pd.read_parquet)):
        for suffix in (kind, kind.upper()):
            paths = tune_jobs.export("mine", output=tmp_path / f"out.{suffix}", storage=tmp_path)
            assert paths["trials"] == tmp_path / f"out.{suffix}" / f"trials.{kind}"
            assert len(read(paths["trials"])) == 4


def test_a_folder_that_is_there_gets_a_file_of_the_usual_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = make_sweep_folder(tmp_path / "sweeps" / "mine")
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    for output, at in ((".", "here/mine.tex"), ("..", "mine.tex"), (tmp_path / "sweeps", "sweeps/mine.tex")):
        (path,) = tune_jobs.export(store.folder, "latex", output=output).values()
        assert path.resolve() == (tmp_path / at).resolve()
        assert path.read_text().startswith("%")


def test_several_sweeps_are_for_figures_alone(tmp_path: Path) -> None:
    make_sweep_folder(tmp_path / "mine")
    with pytest.raises(SpecError, match="2 sweeps were given; csv is of one"):
        tune_jobs.export(["mine", "mine"], "csv", storage=tmp_path)
    with pytest.raises(SpecError, match="0 sweeps"):
        tune_jobs.export([], "pdf", storage=tmp_path)


@pytest.mark.parametrize("kind", ["csv", "parquet", "optuna", "sweep"])
def test_what_has_all_settings_takes_no_number_of_them(tmp_path: Path, kind: Any) -> None:
    store = make_sweep_folder(tmp_path / "mine")
    with pytest.raises(SpecError, match=rf"--top 3 \(top\) is of tables in LaTeX and of figures; {kind} has all"):
        tune_jobs.export(store.folder, kind, output=tmp_path / "out", top=3)
    assert not list(tmp_path.glob("out*"))
    assert tune_jobs.export(store.folder, "latex", output=tmp_path / "out", top=1)


# -- LaTeX


def rows_of(text: str) -> list[list[str]]:
    body = text.split(r"\midrule")[1].split(r"\bottomrule", maxsplit=1)[0]
    return [line.removesuffix(r" \\").split(" & ") for line in body.strip().splitlines()]


def test_the_latex_table_has_the_settings_that_the_frame_has(data: SweepData) -> None:
    text = latex_table(data, name="my_sweep", env_id="CartPole-v0", top=4)
    frame = settings_frame(data)
    rows = rows_of(text)
    assert len(rows) == 4
    heads = text.split(r"\toprule")[1].split(r"\midrule")[0].strip().removesuffix(r" \\").split(" & ")
    assert heads[0] == r"hidden\_sizes"
    spec = cast("re.Match[str]", re.search(r"begin\{tabular\}\{(l+)(r+)\}", text))
    assert len(spec[1]) == 3
    for cells, (_, row) in zip(rows, frame.iterrows(), strict=False):
        assert len(cells) == len(heads) == len(spec[1] + spec[2])
        assert cells[0] == row["hidden_sizes"]
        assert cells[3:5] == [str(row["num_seeds"]), f"{row['mean']:.1f}"]
        low, high = (float(end.replace("$-$", "-")) for end in cells[5].split(" to "))
        assert low == pytest.approx(row["lower"], abs=0.051)
        assert high == pytest.approx(row["upper"], abs=0.051)
        assert cells[6] == f"{row['num_solved']} of {row['num_seeds']}"
    assert "The best 4 of 20 settings of my\\_sweep" in text
    assert text.count("{") - text.count(r"\{") == text.count("}") - text.count(r"\}")


def test_the_latex_table_says_what_is_not_known() -> None:
    text = latex_table(data_of(), name="one", env_id="CartPole-v0")
    assert {cells[5] for cells in rows_of(text)} == {"--"}
    assert "Smyth" not in text
    empty = latex_table(SweepData([], {}, "final", num_env_steps=1, threshold=None), name="x", env_id="y")
    assert "None of its trials has ended" in empty


def test_env_steps_are_told_without_a_minus(data: SweepData) -> None:
    steps = dataclasses.replace(data, objective="steps_to_threshold")
    text = latex_table(steps, name="x", env_id="y")
    assert "env steps to threshold" in text
    for cells in rows_of(text):
        assert float(cells[4]) > 0
        low, high = map(float, cells[5].split(" to "))
        assert low < high


def test_latexs_letters_are_escaped() -> None:
    assert escaped(r"a_b & 5% of {x} \ ~") == r"a\_b \& 5\% of \{x\} \textbackslash{} \textasciitilde{}"


# -- Optuna


def spec_of(**given: Any) -> SweepSpec:
    return SweepSpec.model_validate(
        {"env": {"id": "CartPole-v0"}, "algorithm": "ppo", "space": SPACE, "num_samples": 5} | given
    )


def test_a_study_has_the_trials_that_ended(data: SweepData) -> None:
    optuna = pytest.importorskip("optuna")
    ended = [
        item.model_copy(update={"status": "stopped"}) if item.trial_id == "t0007" else item for item in data.trials
    ]
    study = make_study(spec_of(), dataclasses.replace(data, trials=ended), "mine")
    by_id = {item.user_attrs["trial_id"]: item for item in study.trials}
    assert sorted(by_id) == [item.trial_id for item in data.trials if item.trial_id != "t0005"]
    states = optuna.trial.TrialState
    assert by_id["t0003"].state == states.FAIL
    assert by_id["t0007"].state == states.PRUNED
    frame = make_frame(data, "trials").set_index("trial_id")
    for trial_id, item in by_id.items():
        if item.state == states.COMPLETE:
            assert item.value == frame.loc[trial_id, "objective_score"]
        point = next(each.point for each in data.trials if each.trial_id == trial_id)
        assert item.params == {**point, "hidden_sizes": str(point["hidden_sizes"][0])}
        known = {each.num_env_steps: each.evaluation_return for each in data.results[trial_id]}
        assert item.intermediate_values == {key: value for key, value in known.items() if value is not None}
    best = by_id[study.best_trial.user_attrs["trial_id"]]
    assert best.value == frame.loc[[key for key in by_id if key not in ("t0003", "t0007")], "objective_score"].max()


def test_a_study_of_every_kind_of_domain_may_be_kept_in_a_file(tmp_path: Path) -> None:
    optuna = pytest.importorskip("optuna")
    space = {
        "lr": {"qloguniform": [1e-4, 1e-2, 1e-4]}, "gamma": {"quniform": [0.9, 0.99, 0.01]},
        "gae_lambda": {"uniform": [0.8, 1.0]}, "clip_param": {"loguniform": [0.1, 0.4]},
        "num_epochs": {"randint": [1, 9]}, "minibatch_size": {"qrandint": [32, 128, 32]},
        "num_envs": {"lograndint": [1, 9]}, "train_batch_size": {"qlograndint": [256, 1024, 128]},
        "hidden_sizes": {"choice": [[64, 64], [8]]}, "grad_clip": {"grid": [None, 0.5]},
    }  # fmt: skip
    make_sweep_folder(tmp_path / "mine", space=space, seeds_per_point=1, num_samples=4)
    paths = tune_jobs.export("mine", "optuna", output=tmp_path / "new" / "study", storage=tmp_path)
    kept = optuna.load_study(study_name="mine", storage=f"sqlite:///{paths['study']}")
    records = tune_jobs.trials("mine", storage=tmp_path)
    assert len(kept.trials) == len(records) == 8
    for item, record in zip(kept.trials, records, strict=True):
        point = {**record.point, "hidden_sizes": "x".join(map(str, record.point["hidden_sizes"]))}
        assert item.params == pytest.approx(point)
    with pytest.raises(CannotRunError, match="exists already"):
        tune_jobs.export("mine", "optuna", output=paths["study"], storage=tmp_path)


def test_a_study_that_could_not_be_written_whole_is_not_left(
    data: SweepData, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("optuna")

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("tune_jobs.search.study._as_optunas", interrupt)
    with pytest.raises(KeyboardInterrupt):
        make_study(spec_of(), data, "mine", tmp_path / "study.db")
    assert not (tmp_path / "study.db").exists()


def test_numbers_that_are_none_are_left_out_of_a_study() -> None:
    optuna = pytest.importorskip("optuna")
    shown = [trial(0, {"lr": 0.001}, time_s=math.nan, training_return=math.inf), trial(1, {"lr": 0.002})]
    results = {"t0000": [iteration(1, 3.0)], "t0001": [iteration(1, None)]}
    data = SweepData(shown, results, "final", num_env_steps=100, threshold=None)
    study = make_study(spec_of(space={"lr": {"uniform": [1e-4, 1]}}), data, "mine")
    assert [item.state for item in study.trials] == [optuna.trial.TrialState.COMPLETE, optuna.trial.TrialState.FAIL]
    assert not {"time_s", "training_return"} & set(study.trials[0].user_attrs)


def test_a_population_has_no_study_and_no_table(tmp_path: Path) -> None:
    data = data_of()
    with pytest.raises(SpecError, match="population based training"):
        make_study(spec_of(scheduler="pbt", space={"lr": {"uniform": [1e-4, 1e-2]}}), data, "mine")
    make_sweep_folder(tmp_path / "mine", scheduler="pbt", seeds_per_point=1)
    with pytest.raises(SpecError, match="no settings to list"):
        tune_jobs.export("mine", "latex", output=tmp_path / "x", storage=tmp_path)


def test_without_optuna_a_study_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: None if name == "optuna" else found(name))
    with pytest.raises(CannotRunError) as caught:
        make_study(spec_of(), data_of(), "mine")
    assert "tune-jobs[tpe]" in caught.value.hint
