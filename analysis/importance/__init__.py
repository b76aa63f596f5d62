"""What mattered in a sweep: which hyperparameters its scores depend on, by how much, and how sure that is.

`what_mattered` is the way in; `analysis.importance.answer` says what its results mean.
"""

from analysis.importance.answer import Edge as Edge
from analysis.importance.answer import Effect as Effect
from analysis.importance.answer import Importance as Importance
from analysis.importance.answer import Interaction as Interaction
from analysis.importance.answer import Level as Level
from analysis.importance.answer import WhatMattered as WhatMattered
from analysis.importance.judge import what_mattered as what_mattered

__all__ = ["Edge", "Effect", "Importance", "Interaction", "Level", "WhatMattered", "what_mattered"]
