"""Find what steps copies of an environment together."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from policies.envs.copies import Stepper
from policies.envs.landers import Landers
from policies.envs.runners import Runners


def stepper_of(env_id: str, env_args: Mapping[str, Any] | None) -> Stepper | None:
    """Return what steps an environment's copies together; None: each has to step itself.

    No environment is made of which no copies could be stepped so. What one of the others raises is left to those who
    make it next.
    """
    return Runners.of(env_id, env_args) or Landers.of(env_id, env_args)
