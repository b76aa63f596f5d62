"""`python -m tests.benchmarks`: tables of figures, every contender in the same run.

Run it on a machine that does nothing else.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from rich.console import Console
from rich.table import Table

from tests.benchmarks import beside, dqn, objects, populations, ppo, workload
from tests.benchmarks.cluster import rows as cluster
from tests.benchmarks.service import rows as service

_TOGETHER = ("ppo", "many", "dqn", "beside", "populations", "service", "objects")
_PARTS = (*_TOGETHER, "cluster", "largest")
"""`cluster` takes an hour, with 10,000 trials and a cluster of its own; `largest` is the last of those alone."""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--env-steps", type=int, default=workload.NUM_ENV_STEPS, help="of each of the 20 trials")
    parser.add_argument("--dqn-env-steps", type=int, default=dqn.NUM_ENV_STEPS, help="of each DQN trial")
    parser.add_argument("--only", choices=_PARTS, help="these rows alone")
    parser.add_argument("--no-peers", action="store_true")
    parser.add_argument("--hours", type=float, default=24.0, help="of the service, simulated at speed")
    parser.add_argument("--trials", type=int, default=10_000, help="of the cluster's largest sweep, of 3 s each")
    parser.add_argument("--save", type=Path, help="a file for what the cluster's sweeps cost; see cluster/model.py")
    options = parser.parse_args()
    # A table a part, as soon as it is measured: what fails in a later one takes none of the hours before.
    for part in [options.only] if options.only else _TOGETHER:
        table = Table(title=f"{ppo.machine_name()}, medians of {options.repeats} where a row says nothing else")
        for column in ("figure", "measured", "at most / at least"):
            table.add_column(column)
        for row in _rows(part, options):
            table.add_row(*row)
        Console().print(table)


def _rows(part: str, options: argparse.Namespace) -> list[ppo.Row]:
    measures: dict[str, Callable[[], list[ppo.Row]]] = {
        "ppo": lambda: ppo.rows(options) + ppo.command_rows(),
        "many": lambda: ppo.many_rows(options.env_steps),
        "dqn": lambda: dqn.rows(options.repeats, options.dqn_env_steps, peers=not options.no_peers),
        "beside": lambda: beside.rows(options.repeats),
        "populations": lambda: populations.rows(options),
        "service": lambda: service.rows(options.repeats, options.hours),
        "objects": lambda: objects.rows(options.repeats),
        "cluster": lambda: cluster.rows(options.repeats, options.trials, options.save),
        "largest": lambda: cluster.largest(options.trials, options.save),
    }
    return measures[part]()


if __name__ == "__main__":
    main()
