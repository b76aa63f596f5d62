"""Seeds: reproducible, stable when more are asked for, and disjoint."""

import numpy as np
import pytest

from tune_jobs.spec.seeds import MAX_EPISODES, SEEDS_PER_TRIAL, confirmation_seeds, evaluation_seeds, trial_seeds


@pytest.mark.parametrize("sweep_seed", [0, 1, 2**40])
def test_training_evaluation_and_confirmation_seeds_are_disjoint(sweep_seed: int) -> None:
    training = trial_seeds(sweep_seed, 500)
    evaluation = evaluation_seeds(sweep_seed, MAX_EPISODES)
    confirmation = confirmation_seeds(sweep_seed, MAX_EPISODES)
    assert 0 <= min(evaluation) <= max(evaluation) < 2**19
    assert 2**19 <= min(confirmation) <= max(confirmation) < 2**20
    assert min(training) >= 2**20
    assert max(training) + SEEDS_PER_TRIAL <= 2**31


def test_the_blocks_of_trials_do_not_overlap() -> None:
    # Enough trials that two first draws collide: about 20,000**2 / 2 / 2,000,000 = 95 pairs.
    seeds = np.sort(trial_seeds(0, 20_000))
    assert np.diff(seeds).min() >= SEEDS_PER_TRIAL


def test_more_trials_change_no_earlier_seed() -> None:
    assert trial_seeds(5, 3_000)[:1_000] == trial_seeds(5, 1_000)


def test_more_episodes_change_no_earlier_seed() -> None:
    assert evaluation_seeds(5, 100)[:10] == evaluation_seeds(5, 10)
    assert confirmation_seeds(5, 100)[:10] == confirmation_seeds(5, 10)


def test_sweep_seeds_give_different_seeds() -> None:
    assert set(trial_seeds(0, 50)).isdisjoint(trial_seeds(1, 50))
    assert evaluation_seeds(0, 10) != evaluation_seeds(1, 10)


def test_seeds_are_what_they_always_were() -> None:
    # A change here breaks `extend` and `resume` of the sweeps people already have.
    assert trial_seeds(0, 3) == [1041290240, 859925504, 1494573056]
    assert evaluation_seeds(0, 2) == (172066, 172067)
    assert confirmation_seeds(0, 2) == (758241, 758242)


def test_asking_for_too_many_is_an_error() -> None:
    with pytest.raises(ValueError, match="trials"):
        trial_seeds(0, 2**21)
    with pytest.raises(ValueError, match="episodes"):
        evaluation_seeds(0, MAX_EPISODES + 1)
