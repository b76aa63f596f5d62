"""Searches whose truth is known: the scores of points that depend on their hyperparameters in given ways.

`python tests/unit/simulated_searches.py` prints the tables of decision 30, in some minutes. fANOVA is in the table if
scikit-learn is installed.
"""

from __future__ import annotations

import importlib.util
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[2]))

from analysis.importance.chance import term_chances
from analysis.importance.judge import resampled_shares
from analysis.importance.model import fit, make_terms, ranks
from analysis.importance.searched import searched

Floats = NDArray[np.float64]
SPACE: dict[str, dict[str, list[Any]]] = {
    "lr": {"loguniform": [1e-5, 1e-1]},
    "activation": {"choice": ["tanh", "relu"]},
    "hidden_sizes": {"choice": [[16], [64], [64, 64], [256]]},
    "entropy_coeff": {"choice": [0.0, 0.01, 0.1]},
    "gae_lambda": {"uniform": [0.8, 1.0]},
    "gamma": {"choice": [0.9, 0.98, 0.999]},
    "num_epochs": {"choice": [2, 4, 8]},
}
NAMES = tuple(SPACE)
Draws = dict[str, Floats]
"""Of each hyperparameter the place of its value between the ends, or the index of the value."""
World = Callable[[np.random.Generator, Draws], Floats]
Method = Callable[[Draws, Floats], Sequence[float]]


def draw(rng: np.random.Generator, size: int) -> Draws:
    """Draw points as a random search does."""
    listed = {name: domain["choice"] for name, domain in SPACE.items() if "choice" in domain}
    return {
        name: rng.integers(len(listed[name]), size=size).astype(np.float64) if name in listed else rng.random(size)
        for name in NAMES
    }


def points_of(draws: Draws) -> list[dict[str, Any]]:
    """Return the values that draws stand for."""

    def value(name: str, drawn: float) -> Any:
        (kind, given), *_ = SPACE[name].items()
        if kind == "choice":
            return given[int(drawn)]
        low, high = given
        return float(low * (high / low) ** drawn) if kind == "loguniform" else float(low + (high - low) * drawn)

    return [{name: value(name, float(draws[name][i])) for name in NAMES} for i in range(len(draws["lr"]))]


def additive(rng: np.random.Generator, draws: Draws) -> Floats:
    """lr 40 % (a best value inside), activation 20 %, hidden_sizes 8 %, entropy_coeff 2 %, chance 30 %."""
    parabola = -((draws["lr"] - 0.6) ** 2) / 0.13
    tanh = np.where(draws["activation"] == 0, 1.0, -1.0)
    sizes, entropy = (draws["hidden_sizes"] - 1.5) / 1.118, (draws["entropy_coeff"] - 1.0) / 0.816
    known = 0.4**0.5 * parabola + 0.2**0.5 * tanh + 0.08**0.5 * sizes + 0.02**0.5 * entropy
    scores: Floats = known + 0.3**0.5 * rng.standard_normal(len(tanh))
    return scores


def shifted(rng: np.random.Generator, draws: Draws) -> Floats:
    """Each activation has another best lr."""
    tanh = np.where(draws["activation"] == 0, 1.0, -1.0)
    parabola = -((draws["lr"] - 0.5 - 0.2 * tanh) ** 2) / 0.13
    sizes = (draws["hidden_sizes"] - 1.5) / 1.118
    scores: Floats = 0.5**0.5 * parabola + 0.1**0.5 * (tanh + sizes) + 0.3**0.5 * rng.standard_normal(len(tanh))
    return scores


def capped(rng: np.random.Generator, draws: Draws) -> Floats:
    """The additive one, where a third of the points reach the env's highest score and tie."""
    scores: Floats = np.minimum(500.0, 250.0 * (additive(rng, draws) + 2.9))
    return scores


def cliff(rng: np.random.Generator, draws: Draws) -> Floats:
    """Points solve the env in 9 of 10 runs within a window of lr, another one for each activation; else in 1 of 10."""
    lr, tanh = draws["lr"], draws["activation"] == 0
    inside = (tanh & (lr > 0.45) & (lr < 0.8)) | (~tanh & (lr > 0.3) & (lr < 0.6))
    solves = rng.random(len(lr)) < np.where(inside, 0.9, 0.1)
    return np.where(solves, 500.0, rng.uniform(20.0, 200.0, len(lr)) + 60.0 * (draws["gamma"] == 1))


def nothing(rng: np.random.Generator, draws: Draws) -> Floats:
    """Nothing but chance."""
    return rng.standard_normal(len(draws["lr"]))


def tails(rng: np.random.Generator, draws: Draws) -> Floats:
    """Nothing but chance, where most points tie."""
    return np.minimum(rng.standard_normal(len(draws["lr"])), -0.6)


WORLDS: dict[str, World] = {
    "sum of effects": additive,
    "the same, a third tie at the top": capped,
    "best lr differs by activation": shifted,
    "window of lr, differs by activation": cliff,
    "nothing": nothing,
    "nothing, most tie": tails,
}


def truth(world: World, size: int = 300_000) -> Floats:
    """Return the share of the variance of ranks that each hyperparameter accounts for by itself."""
    rng = np.random.default_rng(0)
    draws = draw(rng, size)
    ranked = ranks(list(world(rng, draws)))
    shares = []
    for name in NAMES:
        group = draws[name].astype(int) if "choice" in SPACE[name] else (draws[name] * 50).astype(int)
        counts = np.bincount(group)
        means = np.bincount(group, ranked) / counts
        shares.append(float((counts * (means - ranked.mean()) ** 2).sum() / size / ranked.var()))
    return np.array(shares)


def ours(draws: Draws, scores: Floats) -> Sequence[float]:
    """The additive mixed model."""
    shares: list[float] = fit(make_terms(searched(SPACE, points_of(draws))), ranks(list(scores))).shares[0].tolist()
    return shares


def by_optuna(evaluator: Any, *, of_ranks: bool = False) -> Method:
    """Return an evaluator of Optuna's as a method."""

    def evaluate(draws: Draws, scores: Floats) -> Sequence[float]:
        import optuna

        distributions: dict[str, optuna.distributions.BaseDistribution] = {
            "lr": optuna.distributions.FloatDistribution(1e-5, 1e-1, log=True),
            "gae_lambda": optuna.distributions.FloatDistribution(0.8, 1.0),
        }
        for name, domain in SPACE.items():
            if "choice" in domain:
                distributions[name] = optuna.distributions.CategoricalDistribution(range(len(domain["choice"])))
        study = optuna.create_study(direction="maximize")
        values = ranks(list(scores)) if of_ranks else scores
        for index, point in enumerate(points_of(draws)):
            params = {name: int(draws[name][index]) if "choice" in SPACE[name] else point[name] for name in NAMES}
            study.add_trial(
                optuna.trial.create_trial(params=params, distributions=distributions, value=float(values[index]))
            )
        found = evaluator.evaluate(study)
        return [found.get(name, 0.0) for name in NAMES]

    return evaluate


def _methods() -> dict[str, tuple[int, Method]]:
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    warnings.simplefilter("ignore")
    evaluators = optuna.importance
    methods: dict[str, tuple[int, Method]] = {"ours": (60, ours)}
    for quantile in (0.1, 0.25, 0.5):
        evaluator = evaluators.PedAnovaImportanceEvaluator(target_quantile=quantile)
        methods[f"PED-ANOVA, best {quantile:.0%}"] = (60, by_optuna(evaluator))
    if importlib.util.find_spec("sklearn") is not None:
        methods["fANOVA of ranks"] = (12, by_optuna(evaluators.FanovaImportanceEvaluator(seed=0), of_ranks=True))
    return methods


def _kendall(found: Floats, true: Floats) -> float:
    """Return how many pairs that truly differ are in the right order, less those in the wrong one, as a share."""
    signs = [
        np.sign(found[i] - found[j]) * np.sign(true[i] - true[j])
        for i in range(len(true))
        for j in range(i)
        if abs(true[i] - true[j]) > 0.02
    ]
    return float(np.mean(signs)) if signs else float("nan")


def _compare() -> None:
    print("world | points | method | order | to idle | error | ms")
    for name, world in WORLDS.items():
        true = truth(world)
        idle, whole = true < 0.001, true.sum()
        print(name, dict(zip(NAMES, true.round(3).tolist(), strict=True)), flush=True)
        for size in (20, 60, 200):
            for told, (repeats, method) in _methods().items():
                rng, order, lost, error = np.random.default_rng(1), [], [], []
                start = time.perf_counter()
                for _ in range(repeats):
                    draws = draw(rng, size)
                    found = np.asarray(method(draws, world(rng, draws)))
                    relative = found / found.sum() if found.sum() > 0 else np.full(len(NAMES), 1 / len(NAMES))
                    order.append(_kendall(found, true))
                    lost.append(relative[idle].sum())
                    error.append(np.abs(relative - true / whole).mean() if whole > 0.01 else np.nan)
                cells = (f"{np.mean(order):.2f}", f"{100 * np.mean(lost):.0f} %", f"{100 * np.mean(error):.1f}")
                took = 1_000 * (time.perf_counter() - start) / repeats
                print(
                    "|", name, "|", size, "|", told, "|", *" | ".join(cells).split(" "), "|", f"{took:.0f}", flush=True
                )


def _coverages(repeats: int = 100) -> None:
    print("world | points | truth | mean | intervals that hold the truth | width | clear | any idle one is clear")
    for name, world in WORLDS.items():
        true = truth(world)
        idle = true < 0.001
        for size in (20, 60, 200):
            rng = np.random.default_rng(3)
            shares, clear, held, widths = [], [], [], []
            for _ in range(repeats):
                draws = draw(rng, size)
                terms, outcome = make_terms(searched(SPACE, points_of(draws))), ranks(list(world(rng, draws)))
                fitted = fit(terms, outcome)
                low, high = np.quantile(resampled_shares(terms, outcome, fitted, rng), [0.025, 0.975], axis=0)
                shares.append(fitted.shares[0])
                clear.append(term_chances(terms, outcome, rng) <= 0.05)
                # The shares that are given are rounded to per cent.
                held.append((low <= true + 0.005) & (true - 0.005 <= high))
                widths.append(high - low)
            rows = [np.mean(item, axis=0).round(2).tolist() for item in (shares, held, widths, clear)]
            false = np.array(clear)[:, idle].any(axis=1).mean()
            print("|", name, "|", size, "|", true.round(2).tolist(), *rows, f"{100 * false:.0f} %", flush=True)


if __name__ == "__main__":
    if "coverage" not in sys.argv[1:]:
        _compare()
    _coverages()
