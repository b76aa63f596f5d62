"""Networks of a stack beside the same networks, each alone."""

import torch
from torch import Tensor

from policies.packed.networks import StackedNetworks


def check_alone(stack: StackedNetworks, alone: StackedNetworks, x: Tensor, gradient: Tensor) -> Tensor:
    """Compare what each network of a stack computes with what it does in a stack of one, to the last bit.

    Returns the outputs.

    Args:
        stack: The networks.
        alone: A stack of one network of the same shape, whose weights are written over.
        x: Inputs with their ones, shape (num_networks, B, num_inputs + 1).
        gradient: Of the outputs, shape (num_networks, B, num_outputs).
    """
    outputs = stack.forward(x)
    stack.backward(gradient)
    for place in range(len(x)):
        one = slice(place, place + 1)
        alone.weights.copy_(stack.weights[one])
        assert torch.equal(alone.forward(x[one]), outputs[one])
        assert torch.equal(alone.evaluate(x[one], 0, 1), outputs[one])
        alone.backward(gradient[one])
        assert torch.equal(alone.gradients, stack.gradients[one])
    return outputs
