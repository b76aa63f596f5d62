"""What is drawn of the errors of settings: one error for all where they are taken to have one variance."""

import numpy as np

from analysis.statistics import moderated_means


def test_settings_of_one_variance_are_wrong_about_it_together_and_others_each_by_itself() -> None:
    alike = moderated_means([[1.0, 2.0], [2.0, 3.0], [3.0, 4.0]])
    assert alike.common_variance
    ratios = alike.relative_errors(np.random.default_rng(0), 50)
    assert ratios.shape == (50, 3)
    assert (ratios == ratios[:, :1]).all()
    assert len(set(ratios[:, 0].tolist())) == 50
    apart = moderated_means([[1.0, 1.0, 1.1], [2.0, 30.0, 60.0], [3.0, 3.0, 3.0]])
    assert not apart.common_variance
    ratios = apart.relative_errors(np.random.default_rng(0), 50)
    assert (ratios[:, 0] != ratios[:, 1]).all()
