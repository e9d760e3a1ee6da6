"""torch's Adam over one vector, by a kernel on the optimizer's own state."""

from collections.abc import Sequence
from itertools import chain
from operator import attrgetter, is_, itemgetter
from typing import Any

import torch as th
from torch.optim import optimizer as torch_optimizer

from sb3_rainbow.fast import learning_kernels as kernels

# Options of torch's Adam that the kernel does not know
_UNKNOWN = ("amsgrad", "maximize", "decoupled_weight_decay", "differentiable")
GRAD = attrgetter("grad")
_ENTRIES = itemgetter("exp_avg", "exp_avg_sq", "step")


class AdamOnVector:
    """One step of Adam for parameters that are parts of one vector.

    The moments become parts of vectors as well. They stay where torch looks for them, entry by
    entry in the optimizer's state, so that saving, loading and torch's own steps see them. The
    ``gradients`` are the parts of ``gradient``, as the parameters are those of ``vector``.
    """

    def __init__(
        self,
        parameters: list[th.nn.Parameter],
        vector: th.Tensor,
        gradient: th.Tensor,
        gradients: list[th.Tensor],
    ) -> None:
        self.parameters, self.vector, self.gradients = parameters, vector, gradients
        self.vector.grad = gradient
        self._values, self._gradient = vector.numpy(), gradient.numpy()
        self.ids = {id(p) for p in parameters}
        self._tensors: list[th.Tensor] = []
        self._address = 0

    @staticmethod
    def is_possible(optimizer: th.optim.Optimizer, ids: set[int]) -> bool:
        """Whether it is an Adam over parameters of these identities, with options known here."""
        group = optimizer.param_groups[0]
        return (
            type(optimizer) is th.optim.Adam
            and len(optimizer.param_groups) == 1
            and set(map(id, group["params"])) == ids
            and not any(map(group.get, _UNKNOWN))
        )

    def is_ready(self, optimizer: th.optim.Optimizer) -> bool:
        """Whether the next steps are the kernel's alone, for as long as nobody else interferes."""
        if "step" in vars(optimizer) or has_hooks(optimizer):
            return False
        return self._has_moments(list(map(optimizer.state.get, self.parameters)))

    def step_when_ready(self, optimizer: th.optim.Optimizer, max_grad_norm: float | None) -> None:
        """As :meth:`step`, after :meth:`is_ready`."""
        if max_grad_norm is not None:
            kernels.clip(self._gradient, max_grad_norm)
        self._step(optimizer)

    def step(self, optimizer: th.optim.Optimizer, max_grad_norm: float | None) -> None:
        """Clip the gradient, then do what ``optimizer.step()`` does."""
        states = list(map(optimizer.state.get, self.parameters))
        is_first = not any(states)
        learn = all(p.grad is not None for p in self.parameters)
        if max_grad_norm is not None:
            if is_first:
                th.nn.utils.clip_grad_norm_([self.vector], max_grad_norm)
            else:
                kernels.clip(self._gradient, max_grad_norm)
        if is_first or "step" in vars(optimizer) or not (learn and self._has_moments(states)):
            # torch itself creates a parameter's state; a learning rate scheduler counts the calls;
            # some parameters do not always train.
            optimizer.step()
        elif has_hooks(optimizer):
            th.optim.Optimizer.profile_hook_step(self._after_hooks)(optimizer)
        else:
            self._step(optimizer)

    def _after_hooks(self, optimizer: th.optim.Optimizer) -> None:
        if all(map(is_, map(GRAD, self.parameters), self.gradients)):
            self._step(optimizer)
        else:  # a hook put in a gradient of its own
            th.optim.Adam.step.__wrapped__(optimizer)  # type: ignore[attr-defined]

    def _has_moments(self, states: list[Any]) -> bool:
        """Whether all parameters have moments of one age; moments become parts of vectors."""
        if not all(states):
            return False
        tensors = list(chain.from_iterable(map(_ENTRIES, states)))
        # One address stands for all: copying and pickling separate them all.
        address = tensors[0].data_ptr()
        if address != self._address or not all(map(is_, tensors, self._tensors)):
            self._first = share(tensors[0::3], self.parameters).numpy()
            self._second = share(tensors[1::3], self.parameters).numpy()
            self._steps = share(tensors[2::3]).numpy()
            self._tensors, self._address = tensors, tensors[0].data_ptr()
        steps = self._steps.tolist()
        return steps.count(steps[0]) == len(steps)

    def _step(self, optimizer: th.optim.Optimizer) -> None:
        group = optimizer.param_groups[0]
        self._steps += 1
        beta1, beta2 = group["betas"]
        kernels.adam_step(
            self._values,
            self._gradient,
            self._first,
            self._second,
            float(group["lr"]),
            float(beta1),
            float(beta2),
            float(group["eps"]),
            float(group["weight_decay"]),
            float(self._steps[0]),
        )


def has_hooks(optimizer: th.optim.Optimizer) -> bool:
    """Whether an optimizer's step calls others."""
    return bool(
        optimizer._optimizer_step_pre_hooks
        or optimizer._optimizer_step_post_hooks
        or torch_optimizer._global_optimizer_pre_hooks
        or torch_optimizer._global_optimizer_post_hooks
    )


def parts(vector: th.Tensor, tensors: Sequence[th.Tensor]) -> list[th.Tensor]:
    """Views of a vector, one after another, with the shapes and memory formats of dense tensors."""
    sizes = [t.numel() for t in tensors]
    return [
        part.as_strided(t.shape, t.stride(), part.storage_offset())
        for part, t in zip(vector.split(sizes), tensors, strict=True)
    ]


@th.no_grad()
def share(tensors: Sequence[th.Tensor], like: Sequence[th.Tensor] | None = None) -> th.Tensor:
    """Make float32 tensors parts of a new vector on the CPU, laid out as those in ``like``."""
    vector = th.empty(sum(t.numel() for t in tensors), dtype=th.float32)
    for tensor, part in zip(tensors, parts(vector, like or tensors), strict=True):
        tensor.data = part.copy_(tensor)
    return vector
