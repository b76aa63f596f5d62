"""The names of the activations that networks may have; they are defined nowhere else.

| name | after a layer's output x |
|---|---|
| linear | x |
| relu | max(x, 0) |
| tanh | (e^x - e^-x) / (e^x + e^-x) |
| silu | x / (1 + e^-x) |
| elu | x where x > 0, else e^x - 1 |
| gelu | x times the normal distribution function of x; not its approximation by tanh |

Each maps 0 to 0, which padded networks rely on. Implementations are looked up by these names: torch's modules in
`policies.networks.layers`, RLlib's names in `policies.networks.parts`, NumPy's functions in
`policies.portable.forward`, and forward and backward passes of packs in `policies.packed.networks`.
"""

from __future__ import annotations

from typing import Literal, get_args

Activation = Literal["linear", "relu", "tanh", "silu", "elu", "gelu"]
ACTIVATIONS: tuple[str, ...] = get_args(Activation)
