"""Build the stacked networks and optimizers from members, and write them back.

Shapes: M members, n networks per member; row k * M + m is network k of member m.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from policies.envs.images import SeenImage
from policies.packed.convolutions import convolutions_for
from policies.packed.member import AnyMember, NetworkLayout, network_layouts, num_stack_outputs
from policies.packed.networks import StackedNetworks
from policies.packed.optimizers import StackedOptimizer


class StackedRows:
    """The stacked networks of some members, made from the members' own weights.

    Args:
        members: Members with equally many layers and the same convolutions.
        shape: The shape of what networks see of an observation: (n,), or (height, width, channels).
        num_outputs: The number of outputs of a policy's head, or of actions.
        device: Where the weights lie.
        prefix: The prefix of the weights' names: that of the target networks, or none.
        image: The image among the numbers of an observation, for convolutions; None: it is one as a whole, or has none.
    """

    def __init__(
        self,
        members: Sequence[AnyMember],
        shape: Sequence[int],
        num_outputs: int,
        device: str,
        prefix: str = "",
        *,
        image: SeenImage | None = None,
    ) -> None:
        first = members[0].hyperparams
        self._members, self._num_inputs, self._prefix = members, math.prod(shape), prefix
        if not first.conv_filters:
            image = None
        elif image is not None and first.normalize_observations:
            image = image.unscaled
        num_beside = 0 if image is None else image.num_beside
        convolutions = convolutions_for(shape if image is None else image.shape, first.conv_filters)
        self._layouts = [
            network_layouts(member.hyperparams, num_outputs, convolutions, num_beside) for member in members
        ]
        self.networks_per_member = len(self._layouts[0])
        hidden = [max(sizes) for sizes in zip(*(member.hyperparams.hidden_sizes for member in members), strict=True)]
        num_inputs = math.prod(convolutions[-1].out) + num_beside if convolutions else math.prod(shape)
        sizes = (num_inputs, *hidden, num_stack_outputs(first, num_outputs))
        num_networks = self.networks_per_member * len(members)
        activations = [member.hyperparams.activation for member in members] * self.networks_per_member
        self.networks = StackedNetworks(num_networks, sizes, activations, device, convolutions, image=image)
        for _, layers, member, layout in self._rows(self.networks.layers):
            layout.write(layers, member.weights, prefix)

    def _rows(self, layers: Sequence[Tensor]) -> Iterator[tuple[int, list[Tensor], AnyMember, NetworkLayout]]:
        for index, (member, layouts) in enumerate(zip(self._members, self._layouts, strict=True)):
            for number, layout in enumerate(layouts):
                row = number * len(self._members) + index
                yield row, [layer[row] for layer in layers], member, layout

    def per_row(self, value: Callable[[AnyMember], float], dtype: torch.dtype = torch.float32) -> Tensor:
        """Return a number of each member as a column over all rows, (n * M, 1)."""
        return self.per_member(value, dtype).repeat(self.networks_per_member, 1)

    def per_member(self, value: Callable[[AnyMember], float], dtype: torch.dtype = torch.float32) -> Tensor:
        """Return a number of each member as a column, (M, 1)."""
        values = [[value(member)] for member in self._members]
        return torch.tensor(values, dtype=dtype, device=self.networks.weights.device)

    def read_moments(self, optimizer: StackedOptimizer) -> None:
        """Give the optimizer the members' moments and step counts."""
        for name, flat in optimizer.state.items():
            for row, layers, member, layout in self._rows(self.networks.views_of(flat)):
                if name in member.moments:
                    layout.write(layers, member.moments[name])
                optimizer.num_steps[row] = member.num_optimizer_steps

    def write_back(self, optimizer: StackedOptimizer | None = None) -> None:
        """Copy the present weights and the optimizer's state back to the members."""
        for _, layers, member, layout in self._rows(self.networks.layers):
            member.weights.update(layout.read(layers, self._num_inputs, self._prefix))
        if optimizer is None:
            return
        for name, flat in optimizer.state.items():
            for row, layers, member, layout in self._rows(self.networks.views_of(flat)):
                member.moments.setdefault(name, {}).update(layout.read(layers, self._num_inputs))
                member.num_optimizer_steps = int(optimizer.num_steps[row])
