"""Print the results of commands: tables for people, one JSON document for programs."""

from __future__ import annotations

import contextlib
import json
import re
import shlex
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from analysis.wording import PLAIN_NONE, counted, difference_text, range_text, return_text, setting_text
from policies.errors import TuneJobsError, fit
from tune_jobs.cli.characters import has_all_characters
from tune_jobs.cli.going_on import how_to_resume, notes_of
from tune_jobs.process.interruption import last_words
from tune_jobs.sweeps.plain import to_json

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from analysis.best_records import BestRecord, EvaluationRecord, SettingsRecord
    from analysis.records import SweepRecord, TrialRecord, TrialStatus
    from tune_jobs.spec.file import Preset
    from tune_jobs.sweeps.verbs import SweepResult, SweepStatus

_MAX_CANDIDATES = 8
_CONTROLS = re.compile(r"[\x7f-\x9f]")
STATUS_STYLES: dict[TrialStatus, str] = {
    "completed": "green",
    "failed": "red",
    "running": "cyan",
    "stopped": "yellow",
    "paused": "yellow",
}
STATUS_ORDER: tuple[TrialStatus, ...] = ("completed", "stopped", "failed", "running", "paused", "pending")


def print_json(value: Any) -> None:
    """Print one JSON document on standard output."""
    text = json.dumps(to_json(value), indent=2, allow_nan=False, ensure_ascii=not has_all_characters())
    # What JSON leaves as it is, though some terminals obey it; in a document it can only be in a string.
    click.echo(_CONTROLS.sub(lambda found: f"\\u{ord(found.group()):04x}", text))


def show_result(result: SweepResult, *, as_json: bool) -> None:
    """Print the result of a launch, resume or extend, and the paths of its files."""
    try:
        _print_result(result, as_json=as_json)
    finally:
        # Also where nobody reads the result: Ctrl-C ends a pipe's reader too.
        if result.interrupted:
            say_interrupted(result.sweep, how_to_resume(result))


def _print_result(result: SweepResult, *, as_json: bool) -> None:
    if as_json:
        print_json({**to_json(result), "exit_code": result.exit_code})
        return
    from analysis.wording import shown_path

    made = {name: shown_path(path) for name, path in result.artifacts.items()}
    print_outcome(
        result.sweep, result.trials, best=result.best, why_no_best=result.why_no_best,
        paths={"sweep": shown_path(result.place), **made}, notes=notes_of(result),
    )  # fmt: skip


def print_outcome(
    sweep: SweepRecord,
    trials: Sequence[TrialRecord],
    *,
    best: BestRecord | None,
    why_no_best: str | None,
    paths: Mapping[str, str],
    notes: Sequence[str],
) -> None:
    """Print what came of a sweep's trials, and where its files are."""
    console = make_console()
    _print_trial_counts(console, trials)
    if sweep.replications:
        from analysis.answers import replicas_text

        console.print(replicas_text(sweep, trials))
    if best is not None:
        _print_best(console, best)
    elif why_no_best is not None:
        console.print(f"no best policy: {why_no_best}", style="yellow")
    print_facts(console, {name.replace("_", " "): path for name, path in paths.items()})
    for note in notes:
        console.print(f"note: {note}", style="yellow")


def say_interrupted(sweep: SweepRecord, how_to_resume: str) -> None:
    """Say on standard error that a sweep was interrupted, and the command that continues it."""
    click.echo(fit(last_words(how_to_resume, is_done=sweep.state == "completed")), err=True)


def storage_option_of(storage: str | None) -> str:
    """Return the option by which a command finds a sweep that this one has found."""
    return "" if storage is None else f" --storage {shlex.quote(storage)}"


def _print_trial_counts(console: Console, trials: Sequence[TrialRecord]) -> None:
    counts: dict[TrialStatus, int] = dict.fromkeys(STATUS_ORDER, 0)
    for trial in trials:
        counts[trial.status] += 1
    told = ", ".join(f"{number} {status}" for status, number in counts.items() if number)
    steps = sum(trial.num_env_steps for trial in trials)
    console.print(f"{counted(len(trials), 'trial')}: {told}; {counted(steps, 'env step')}")
    for trial in trials:
        if trial.status == "failed":
            console.print(f"{trial.trial_id} failed: {first_line(trial.error)}", style="red")
    print_trial_notes(console, trials)


def print_trial_notes(console: Console, trials: Sequence[TrialRecord]) -> None:
    """Print what was damaged in trials; they went on from something other than their latest checkpoint or results."""
    for trial in trials:
        for note in trial.notes:
            console.print(f"{trial.trial_id}: {note}", style="yellow")


def show_sweeps(statuses: Sequence[SweepStatus], *, as_json: bool) -> None:
    """Print the sweeps of a storage folder."""
    if as_json:
        print_json(statuses)
        return
    console = make_console()
    if not statuses:
        console.print("There are no sweeps here yet.")
        return
    table = make_table("sweep", "state", "trials", "created")
    for status in statuses:
        table.add_row(status.sweep.name, status.told_state, status.told_counts, local_time(status.sweep.created_at))
    console.print(table)


def local_time(unix_time: float) -> str:
    """Return a time, given in seconds since 1970, for people of this machine's time zone."""
    try:
        return time.strftime("%Y-%m-%d %H:%M", time.localtime(unix_time))
    except (ValueError, OverflowError, OSError):
        return PLAIN_NONE


def show_status(
    status: SweepStatus, *, program: str = "tune-jobs", job: Mapping[str, str] | None = None, as_json: bool
) -> None:
    """Print how far a sweep is, what is best so far, how long it will take, and the job that drives it, if one does."""
    if as_json:
        print_json({**to_json(status), **({"job": job} if job else {})})
        return
    told = {"job": f"{job['id']} at {job['address']}: {job['state']}"} if job else {}
    print_facts(make_console(), status.facts(program) | told)


def show_best(best: BestRecord, *, as_json: bool) -> None:
    """Print the winner, the score it was chosen by, and its confirmation."""
    if as_json:
        print_json(best)
        return
    console = make_console()
    _print_best(console, best)
    _print_candidates(console, best)
    _print_front(console, best.settings)


def _print_best(console: Console, best: BestRecord) -> None:
    point = ", ".join(f"{name} {setting_text(value)}" for name, value in best.point.items())
    where = f"{best.checkpoint.trial_id}, iteration {best.checkpoint.iteration}"
    gap = f"gap {difference_text(best.optimism_gap, best.confirmation.mean_return)}"
    facts = {
        "policy": f"{point or 'no searched values'}  ({where}, {best.checkpoint.num_env_steps:,} env steps)",
        **_chosen(best),
        "confirmed at": f"{_returns(best.confirmation)}; {gap}",
        "random policy": f"{_returns(best.random)}{_beside_random(best)}",
    }
    print_facts(console, facts | _verdict(best.confirmation) | _setting_facts(best.settings))


def _beside_random(best: BestRecord) -> str:
    """Return what is to be said of a winner that is no better; empty: it is, or that is not known."""
    from analysis.answers import compared_with_random

    told = {"alike": "; the policy can't be told from it", "worse": "; the policy is worse"}
    return told.get(compared_with_random(best) or "", "")


def _chosen(best: BestRecord) -> dict[str, str]:
    """Return the score that the winner was chosen by, and what it was chosen from, which older records don't have."""
    by = f"{return_text(best.selection_score)} mean evaluation return"
    if best.choice is None:
        return {"chosen by": by}
    from analysis.choice_words import chosen_from

    over = counted(best.choice.winner.num_episodes, "episode")
    return {"chosen by": f"{by} over {over}", "chosen from": chosen_from(best.choice)}


def _print_candidates(console: Console, best: BestRecord) -> None:
    """Print what the policy was chosen from, the leading ones."""
    from analysis.choice_words import COLUMNS, candidate_rows

    rows = candidate_rows(best, none=PLAIN_NONE)
    if best.choice is None or len(rows) < 2:
        return
    from rich.text import Text

    console.print()
    table = make_table(*COLUMNS, wrapped=("95 % interval", "confirmed at", "rejected"))
    for row in rows[:_MAX_CANDIDATES]:
        table.add_row(*map(Text, row.cells))
    console.print(table)
    if len(rows) > _MAX_CANDIDATES:
        console.print(f"{counted(len(rows) - _MAX_CANDIDATES, 'other')}: see --json, or the report", style="dim")
    console.print("Intervals are over episodes of each policy, not over training seeds.", style="dim")
    if best.choice.note:
        console.print(f"note: {best.choice.note}", style="yellow")


def _setting_facts(settings: SettingsRecord | None) -> dict[str, str]:
    """Return which setting to train with, which is another answer than the policy."""
    if settings is None or settings.num_settings < 2:
        return {}
    from analysis.answers import certainty, setting_score
    from analysis.front_words import cheapest_near_text

    best = settings.best
    point = ", ".join(f"{name} {setting_text(value)}" for name, value in best.point.items())
    return {
        "setting": f"{point}  ({counted(len(best.scores), 'seed')}: {', '.join(best.trial_ids[:3])}"
        f"{', ...' if len(best.trial_ids) > 3 else ''})",
        "scored": setting_score(settings),
        "how sure": certainty(settings),
        **({"cheapest near": near} if (near := cheapest_near_text(settings.front)) else {}),
    }


def _print_front(console: Console, settings: SettingsRecord | None) -> None:
    """Print the settings on the front of score against cost, where the sweep asks for it."""
    if settings is None or settings.front is None or settings.num_settings < 2:
        return
    from rich.text import Text

    from analysis.front_words import front_rows, interval_text, near_text, undecided_text

    console.print()
    # Of any width, so that nothing is cut: settings may have many values, and different ones.
    wide = ("setting", "on the front")
    table = make_table("env steps", "score", "95 % interval", "rank", "seeds", *wide, wrapped=wide)
    for item, told in front_rows(settings.front):
        cells = [f"{item.num_env_steps:,.0f}", return_text(item.score), interval_text(item, PLAIN_NONE), str(item.rank)]
        point = ", ".join(f"{name} {setting_text(value)}" for name, value in item.point.items())
        table.add_row(*map(Text, (*cells, str(item.num_seeds), point, told)))
    console.print(table)
    console.print(f"{near_text(settings.front)} {undecided_text(settings.front)}", style="dim")


def show_evaluation(policy: EvaluationRecord, random: EvaluationRecord, *, as_json: bool) -> None:
    """Print the greedy episodes of a policy beside a random one's."""
    if as_json:
        print_json({"policy": policy, "random": random})
        return
    facts = {policy.policy: _returns(policy)}
    if policy.policy != "random":
        facts["random policy"] = _returns(random)
    print_facts(make_console(), facts | {"seeds": span(policy.seeds)} | _verdict(policy))


def span(seeds: Sequence[int]) -> str:
    """Return the range of seeds as "first to last"."""
    return f"{seeds[0]} to {seeds[-1]}"


def _returns(record: EvaluationRecord) -> str:
    low, high = min(record.returns), max(record.returns)
    mean, deviation = record.mean_return, record.std_return
    spread = f"{return_text(mean, deviation)} ± {return_text(deviation, mean)}"
    # Rewards of whole numbers give returns that are some, which need no decimals.
    whole = float(low).is_integer() and float(high).is_integer()
    ends = f"{low:.0f} to {high:.0f}" if whole else range_text(low, high)
    return f"{spread} over {counted(record.num_episodes, 'episode')} ({ends})"


def _verdict(record: EvaluationRecord) -> dict[str, str]:
    if record.solved is None:
        return {record.env_id: "has no threshold to be solved at"}
    return {record.env_id: f"{'solved' if record.solved else 'not solved'} (threshold {record.threshold:g})"}


def show_paths(paths: Mapping[str, Path], *, as_json: bool) -> None:
    """Print where files were written."""
    from analysis.wording import shown_path

    if as_json:
        print_json(paths)
    else:
        print_facts(make_console(), {name: shown_path(path) for name, path in paths.items()})


def going_on(sweep: str, storage: str | None) -> str:
    """Return the command that goes on with a sweep, where it ran: as far as its record says it, or at the service."""
    from tune_jobs.cli.server import program, server_of

    if server_of() is not None:
        return f"{program()} resume {shlex.quote(sweep)}"
    from tune_jobs.store.opening import resume_command
    from tune_jobs.sweeps.sources import find_sweep

    # What was asked for is done: a record that can't be read now makes no error of it.
    with contextlib.suppress(TuneJobsError):
        store = find_sweep(sweep, storage)
        return resume_command(store, store.read_record())
    return f"tune-jobs resume {shlex.quote(sweep)}{storage_option_of(storage)}"


def show_stop(sweep: str, *, was_running: bool, go_on: str, as_json: bool) -> None:
    """Print whether there was something to stop, and the command that goes on with it."""
    if as_json:
        print_json({"sweep": sweep, "was_running": was_running})
    elif was_running:
        click.echo(fit(f"{sweep} stops after the iterations now running; `{go_on}` continues it."))
    else:
        click.echo(f"{sweep} is not running.")


def show_presets(presets: Sequence[Preset], *, as_json: bool) -> None:
    """Print one line per preset: what it is, what it reaches, and what that costs."""
    if as_json:
        print_json([preset._asdict() for preset in presets])
        return
    from rich.text import Text

    console = make_console()
    details = ("what", "expected", "env steps", "time on 2 cores")
    table = make_table("preset", *details, wrapped=details)
    for preset in presets:
        # Passed as Text, because rich would read a title in brackets as a style.
        cells = (preset.title, preset.expected, preset.env_steps, preset.time.removesuffix(" on 2 cores"))
        table.add_row(preset.name, *(Text(cell) for cell in cells))
    console.print(table)
    console.print("Print one with `tune-jobs presets NAME`, run it with `tune-jobs launch NAME`.", style="dim")


def show_preset(preset: Preset, *, as_json: bool) -> None:
    """Print one preset's sweep file, to be copied and changed."""
    if as_json:
        print_json(preset._asdict())
    else:
        click.echo(preset.text, nl=False)


def make_console() -> Console:
    """Return the console that tables are printed to; they end at the terminal's width."""
    from tune_jobs.sweeps.fitting_console import FittingConsole

    # A pipe or a log has no width, and 80 columns would cut tables and paths needlessly.
    width = None if sys.stdout.isatty() else 200
    return FittingConsole(markup=False, highlight=False, emoji=False, width=width, soft_wrap=False)


def make_table(*columns: str, wrapped: Sequence[str] = ("ended by", "trials")) -> Table:
    """Return a table without rows; text wraps in the columns of `wrapped`, and is cut in others."""
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for column in columns:
        table.add_column(column, no_wrap=column not in wrapped, overflow="fold" if column in wrapped else "ellipsis")
    return table


def print_facts(console: Console, facts: Mapping[str, str]) -> None:
    """Print facts, one name with its text per line."""
    from rich.table import Table
    from rich.text import Text

    grid = Table.grid(padding=(0, 2))
    grid.add_column(style="bold", no_wrap=True)
    # Paths are wrapped and never cut with an ellipsis, so that they can be copied.
    grid.add_column(overflow="fold")
    for name, value in facts.items():
        grid.add_row(Text(name), Text(value))
    console.print(grid)


def first_line(text: str | None) -> str:
    """Return the first line of an error."""
    return (text or "no error recorded").strip().splitlines()[0]
