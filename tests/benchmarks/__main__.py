"""`python -m tests.benchmarks`: the table of figures, every contender in the same run.

Run it on a machine that does nothing else.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Console
from rich.table import Table

from tests.benchmarks import dqn, objects, ppo, workload
from tests.benchmarks.cluster import rows as cluster
from tests.benchmarks.service import rows as service

_PARTS = ("ppo", "many", "dqn", "service", "objects", "cluster", "largest")


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
    rows = []
    if options.only in (None, "ppo"):
        rows += ppo.rows(options) + ppo.command_rows()
    if options.only in (None, "many"):
        rows += ppo.many_rows(options.env_steps)
    if options.only in (None, "dqn"):
        rows += dqn.rows(options.repeats, options.dqn_env_steps, peers=not options.no_peers)
    if options.only in (None, "service"):
        rows += service.rows(options.repeats, options.hours)
    if options.only in (None, "objects"):
        rows += objects.rows(options.repeats)
    if options.only == "cluster":
        # An hour with 10,000 trials, and a cluster of its own: not among the others.
        rows += cluster.rows(options.repeats, options.trials, options.save)
    if options.only == "largest":
        # The last of those alone, in a third of that.
        rows += cluster.largest(options.trials, options.save)
    table = Table(title=f"{ppo.machine_name()}, medians of {options.repeats}")
    for column in ("figure", "measured", "at most / at least"):
        table.add_column(column)
    for row in rows:
        table.add_row(*row)
    Console().print(table)


if __name__ == "__main__":
    main()
