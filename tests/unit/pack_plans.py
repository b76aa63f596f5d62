"""Plans of small sweeps whose trials are packed."""

from spec_errors import MINIMAL

from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.spec.file import load_spec

LR = {"lr": {"loguniform": [1e-4, 1e-2]}}
DQN = {"algorithm": "dqn"}
TPE = {"search": "tpe", "space": LR, "num_samples": 30}


def plan(machine=2, records=(), **fields):
    """Of ten trials on a machine with so many CPUs, unless told otherwise."""
    spec = load_spec({**MINIMAL, "num_samples": 10, "space": LR, **fields})
    return make_plan(spec, machine if isinstance(machine, Machine) else Machine(machine), records)


def fake_reasons(monkeypatch, wide):
    """Let trials with these learning rates be such as no pack holds."""

    def why(engine, spec, hyperparams, env):
        return "its lr is odd" if engine.name == "packed" and hyperparams.lr in wide else None

    monkeypatch.setattr("tune_jobs.plan.engine_choice.why_not", why)
