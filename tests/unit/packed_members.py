"""Members of a pack with random weights, made without RLlib, and the same networks as torch modules."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import nn

from policies.hyperparams import PPOHyperparams, TrainedHyperparams
from policies.packed.member import Member, network_layouts

MODULES = {"linear": nn.Identity, "relu": nn.ReLU, "tanh": nn.Tanh, "silu": nn.SiLU, "elu": nn.ELU, "gelu": nn.GELU}
NUM_INPUTS, NUM_OUTPUTS = 4, 3


def names_and_shapes(hyperparams: TrainedHyperparams) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Weights of an RLModule by its names."""
    for layout in network_layouts(hyperparams, NUM_OUTPUTS):
        size = NUM_INPUTS
        for parts in layout.layers:
            for part in parts:
                yield f"{part.name}.weight", (part.stop - part.start, size)
                yield f"{part.name}.bias", (part.stop - part.start,)
            size = parts[-1].stop


def random_member(name: str, seed: int = 0, **values: Any) -> Member[PPOHyperparams]:
    hyperparams = PPOHyperparams(**values)
    rng = np.random.default_rng(seed)
    weights = {
        key: rng.normal(size=shape).astype(np.float32) / np.float32(np.sqrt(shape[-1]))
        for key, shape in names_and_shapes(hyperparams)
    }
    return Member(name, hyperparams, seed, weights, rng=rng)


class Reference(nn.Module):
    """A member's networks, layer by layer, in torch's own modules."""

    def __init__(self, member: Member[PPOHyperparams]) -> None:
        super().__init__()
        self.member = member
        self.layers = nn.ModuleDict()
        for key, value in member.weights.items():
            if key.endswith(".weight"):
                name = key.removesuffix(".weight")
                self.layers[name.replace(".", "/")] = layer = nn.Linear(value.shape[1], value.shape[0])
                with torch.no_grad():
                    layer.weight.copy_(torch.from_numpy(value))
                    layer.bias.copy_(torch.from_numpy(member.weights[f"{name}.bias"]))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Outputs of each network side by side."""
        outputs = []
        function = MODULES[self.member.hyperparams.activation]()
        for layout in network_layouts(self.member.hyperparams, NUM_OUTPUTS):
            features = x
            for (part,) in layout.layers[:-1]:
                features = function(self.layers[part.name.replace(".", "/")](features))
            outputs += [self.layers[part.name.replace(".", "/")](features) for part in layout.layers[-1]]
        return torch.cat(outputs, dim=-1)

    def named(self) -> list[tuple[str, nn.Parameter]]:
        """(name, weight), by the RLModule's names."""
        return [(name.removeprefix("layers.").replace("/", "."), value) for name, value in self.named_parameters()]
