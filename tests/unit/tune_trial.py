"""A trial of Ray Tune's that nothing runs, for tests of what counts its failures and places it."""

import types

from ray.tune import PlacementGroupFactory
from ray.tune.experiment import Trial


class TuneTrial(Trial):  # type: ignore[misc]
    """As much of a trial of Tune's as counts failures and is placed."""

    local_path = None

    def __init__(self) -> None:
        self.trial_id = "1"
        # A restore that fails is counted too.
        self.temporary_state = types.SimpleNamespace(restoring_from=None)
        self.run_metadata = types.SimpleNamespace(num_failures=0, invalidate_cache=lambda: None)
        self.placement_group_factory = PlacementGroupFactory([{"CPU": 1}, {"CPU": 2}], strategy="SPREAD")
