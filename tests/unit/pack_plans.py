"""Plans of small sweeps whose trials are packed."""

from collections.abc import Container, Sequence
from typing import Any

import pytest
from spec_errors import MINIMAL

from analysis.records import TrialRecord
from policies.envs.make import EnvInfo
from policies.hyperparams import TrainedHyperparams
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import SweepPlan, make_plan
from tune_jobs.spec.engines import Engine
from tune_jobs.spec.file import load_spec
from tune_jobs.spec.sweep_spec import SweepSpec

LR: dict[str, Any] = {"lr": {"loguniform": [1e-4, 1e-2]}}
DQN: dict[str, Any] = {"algorithm": "dqn"}
TPE: dict[str, Any] = {"search": "tpe", "space": LR, "num_samples": 30}


def plan(machine: Machine | float = 2, records: Sequence[TrialRecord] = (), **fields: Any) -> SweepPlan:
    """Of ten trials on a machine with so many CPUs, unless told otherwise."""
    spec = load_spec({**MINIMAL, "num_samples": 10, "space": LR, **fields})
    return make_plan(spec, machine if isinstance(machine, Machine) else Machine(machine), records)


def fake_reasons(monkeypatch: pytest.MonkeyPatch, wide: Container[float]) -> None:
    """Let trials with these learning rates be such as no pack holds."""

    def why(engine: Engine, spec: SweepSpec, hyperparams: TrainedHyperparams, env: EnvInfo | None) -> str | None:
        return "its lr is odd" if engine.name == "packed" and hyperparams.lr in wide else None

    monkeypatch.setattr("tune_jobs.plan.engine_choice.why_not", why)
