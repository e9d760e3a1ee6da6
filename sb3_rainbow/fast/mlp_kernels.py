"""Forward pass of Rainbow's multilayer perceptron, written out for one processor core.

All arrays are float32 and C-ordered; matrices of weights are ``(outputs, inputs)``. A network is
one vector of parameters with a table of where each layer lies in it, one row per layer:

    inputs, outputs, noisy (0 or 1), offset among the parameters, offset among the noise, offset
    among the effective weights, offset (per sample) among the hidden units, outputs per noise

A layer's parameters are weight and bias, or, where it is noisy, the means of the weight, its
sigmas, then those of the bias. Its effective weight and bias include the noise of the moment; a
layer without noise has none but its parameters.
"""

import math

import numpy as np
from numpy.typing import NDArray

from sb3_rainbow.replay.compilation import njit

INPUTS, OUTPUTS, NOISY, PARAMETERS, NOISE, EFFECTIVE, HIDDEN, SHARED = range(8)

Vector = NDArray[np.float32]
Matrix = NDArray[np.float32]
Table = NDArray[np.int64]
# Sums may be reordered, so that they run in vector registers; NaN and infinity stay themselves. The
# check for a division by zero (error_model) would forbid vector registers as well.
FAST = {"reassoc", "contract", "nsz", "arcp"}


@njit(cache=True)
def scale_noise(noise: Matrix, table: Table) -> None:
    """As ``scale_noise_`` and ``share_noise_`` of noisy_linear, in place, of rows of all layers."""
    for b in range(noise.shape[0]):
        row = noise[b]
        for i in range(row.shape[0]):
            row[i] = math.copysign(math.sqrt(abs(row[i])), row[i])
        for layer in range(table.shape[0]):
            shared = table[layer, SHARED]
            first = table[layer, NOISE] + table[layer, INPUTS]
            for j in range(table[layer, NOISY] * table[layer, OUTPUTS] if shared > 1 else 0):
                row[first + j] = row[first + j - j % shared]


@njit(cache=True, fastmath=FAST, error_model="numpy")
def effective_weights(parameters: Vector, noise: Vector, table: Table, effective: Vector) -> None:
    """``mu + sigma * epsilon`` for all noisy layers."""
    for layer in range(table.shape[0]):
        if table[layer, NOISY] == 0:
            continue
        n_in, n_out = table[layer, INPUTS], table[layer, OUTPUTS]
        size = n_in * n_out
        p, e = table[layer, PARAMETERS], table[layer, EFFECTIVE]
        first = table[layer, NOISE]
        epsilon_in = noise[first : first + n_in]
        for j in range(n_out):
            epsilon_out = noise[first + n_in + j]
            mu = parameters[p + j * n_in : p + (j + 1) * n_in]
            sigma = parameters[p + size + j * n_in : p + size + (j + 1) * n_in]
            row = effective[e + j * n_in : e + (j + 1) * n_in]
            for i in range(n_in):
                row[i] = mu[i] + sigma[i] * (epsilon_out * epsilon_in[i])
            bias = p + 2 * size + j
            effective[e + size + j] = parameters[bias] + parameters[bias + n_out] * epsilon_out


@njit(cache=True)
def weights_of(
    parameters: Vector, effective: Vector, table: Table, layer: int
) -> tuple[Matrix, Vector]:
    """Views of a layer's weight and bias, with their noise where it is noisy."""
    n_in, n_out = table[layer, INPUTS], table[layer, OUTPUTS]
    size, noisy = n_in * n_out, table[layer, NOISY] == 1
    start = table[layer, EFFECTIVE if noisy else PARAMETERS]
    values = (effective if noisy else parameters)[start : start + size + n_out]
    return values[:size].reshape((n_out, n_in)), values[size:]


@njit(cache=True, fastmath=FAST, error_model="numpy")
def hidden_units(
    parameters: Vector, effective: Vector, table: Table, inputs: Matrix, hidden: Vector
) -> Matrix:
    """ReLU layers up to the head; ``hidden`` keeps every layer's outputs, the last is returned."""
    batch = inputs.shape[0]
    current = inputs
    for layer in range(table.shape[0] - 1):
        weight, bias = weights_of(parameters, effective, table, layer)
        n_out, h = table[layer, OUTPUTS], table[layer, HIDDEN] * batch
        outputs = hidden[h : h + batch * n_out].reshape((batch, n_out))
        np.dot(current, weight.T, outputs)
        for b in range(batch):
            for j in range(n_out):
                outputs[b, j] = max(outputs[b, j] + bias[j], np.float32(0.0))
        current = outputs
    return current


@njit(cache=True, fastmath=FAST, error_model="numpy")
def noisy_streams(parameters: Vector, noise: Matrix, table: Table, inputs: Matrix) -> Matrix:
    """The head's outputs ``(B, n_streams * n_atoms)``, each row of ``inputs`` under its own row of
    ``noise``: no effective weights are formed.
    """
    n_layers, batch = table.shape[0], inputs.shape[0]
    current = inputs
    for layer in range(n_layers):
        n_in, n_out = table[layer, INPUTS], table[layer, OUTPUTS]
        size, p = n_in * n_out, table[layer, PARAMETERS]
        outputs = np.empty((batch, n_out), np.float32)
        np.dot(current, parameters[p : p + size].reshape((n_out, n_in)).T, outputs)
        first = table[layer, NOISE]
        if table[layer, NOISY] == 1:
            turned = np.empty((batch, n_in), np.float32)
            for b in range(batch):
                for i in range(n_in):
                    turned[b, i] = current[b, i] * noise[b, first + i]
            sigma = parameters[p + size : p + 2 * size].reshape((n_out, n_in))
            spread = np.empty((batch, n_out), np.float32)
            np.dot(turned, sigma.T, spread)
            bias = p + 2 * size
            for b in range(batch):
                for j in range(n_out):
                    moved = spread[b, j] + parameters[bias + n_out + j]
                    outputs[b, j] += parameters[bias + j] + noise[b, first + n_in + j] * moved
        else:
            for b in range(batch):
                for j in range(n_out):
                    outputs[b, j] += parameters[p + size + j]
        if layer < n_layers - 1:
            for b in range(batch):
                for j in range(n_out):
                    outputs[b, j] = max(outputs[b, j], np.float32(0.0))
        current = outputs
    return current


@njit(cache=True, fastmath=FAST, error_model="numpy")
def all_streams(
    parameters: Vector, effective: Vector, table: Table, units: Matrix, streams: Matrix
) -> None:
    """The head's outputs, value first where there is one, to ``streams`` ``(B, outputs)``."""
    weight, bias = weights_of(parameters, effective, table, table.shape[0] - 1)
    np.dot(units, weight.T, streams)
    for b in range(units.shape[0]):
        for j in range(bias.shape[0]):
            streams[b, j] += bias[j]


@njit(cache=True, fastmath=FAST, error_model="numpy")
def mean_advantages(
    parameters: Vector, effective: Vector, table: Table, units: Matrix, n_atoms: int, dueling: bool
) -> Matrix:
    """Each action's outputs of the head, the mean over its atoms, ``(B, A)``.

    Without a support this mean is the expectation, up to a part that all actions share. The weights
    are averaged first: one matrix product in the place of ``n_atoms``.
    """
    head_weight, head_bias = weights_of(parameters, effective, table, table.shape[0] - 1)
    n_out, n_in = head_weight.shape
    first = 1 if dueling else 0
    n_actions = n_out // n_atoms - first
    weight, bias = np.zeros((n_actions, n_in), np.float32), np.zeros(n_actions, np.float32)
    share = np.float32(1.0 / n_atoms)
    for a in range(n_actions):
        row = weight[a]
        for j in range((first + a) * n_atoms, (first + a + 1) * n_atoms):
            given = head_weight[j]
            for i in range(n_in):
                row[i] += given[i]
            bias[a] += head_bias[j]
        for i in range(n_in):
            row[i] *= share
        bias[a] *= share
    means = np.empty((units.shape[0], n_actions), np.float32)
    np.dot(units, weight.T, means)
    for b in range(units.shape[0]):
        for a in range(n_actions):
            means[b, a] += bias[a]
    return means


@njit(cache=True, fastmath=FAST, error_model="numpy")
def join(streams: Matrix, n_atoms: int, dueling: bool, shifted: bool, logits: Matrix) -> None:
    """Join value and advantages to ``logits`` ``(B, n_actions * n_atoms)``; if ``shifted``, each
    action's largest logit is zero.
    """
    n_logits = logits.shape[1]
    skipped = n_atoms if dueling else 0
    share = np.float32(n_atoms / n_logits)
    shift = np.empty(n_atoms, np.float32)
    for b in range(streams.shape[0]):
        stream, row = streams[b], logits[b]
        shift[:] = 0.0
        if dueling:
            for first in range(skipped, skipped + n_logits, n_atoms):
                for j in range(n_atoms):
                    shift[j] += stream[first + j]
            for j in range(n_atoms):
                shift[j] = stream[j] - share * shift[j]
        for first in range(0, n_logits, n_atoms):
            part = row[first : first + n_atoms]
            given = stream[skipped + first : skipped + first + n_atoms]
            top = given[0] + shift[0]
            for j in range(n_atoms):
                part[j] = given[j] + shift[j]
                top = max(top, part[j])
            if shifted:
                for j in range(n_atoms):
                    part[j] -= top


@njit(cache=True, fastmath=FAST, error_model="numpy")
def best_actions(
    masses: Matrix,
    support: Vector,
    masks: NDArray[np.bool_],
    actions: NDArray[np.int64],
    categorical: bool,
) -> None:
    """Write to ``actions`` ``(B,)`` the allowed ones of the highest expectation.

    The masses ``(B, n_actions * n_atoms)`` are proportional to the atoms' probabilities, or, if not
    ``categorical``, values that are equally likely. Masks of ``(0, 0)`` allow everything.
    """
    n_atoms = support.shape[0]
    n_actions = masses.shape[1] // n_atoms
    for b in range(masses.shape[0]):
        best, chosen = np.float32(0.0), -1
        for a in range(n_actions):
            if masks.shape[0] > 0 and not masks[b, a]:
                continue
            part = masses[b, a * n_atoms : (a + 1) * n_atoms]
            expectation = part[0]
            if n_atoms > 1:
                total, moment = np.float32(0.0), np.float32(0.0)
                for j in range(n_atoms):
                    total += part[j] if categorical else np.float32(1.0)
                    moment += part[j] * (support[j] if categorical else np.float32(1.0))
                expectation = moment / total
            if chosen < 0 or expectation > best:
                best, chosen = expectation, a
        actions[b] = max(chosen, 0)  # torch's choice where nothing is allowed


@njit(cache=True, fastmath=FAST, error_model="numpy")
def shared_weight(
    head_weight: Matrix, head_bias: Vector, dueling: bool, weight: Matrix, bias: Vector
) -> None:
    """What every action has in common, ``W_V - mean W_A``; zero without dueling."""
    weight[:] = 0.0
    bias[:] = 0.0
    if not dueling:
        return
    n_atoms, n_in = weight.shape
    size, n_actions = n_atoms * n_in, head_bias.shape[0] // n_atoms - 1
    flat, given = weight.reshape(size), head_weight.reshape(head_weight.size)
    for a in range(1, n_actions + 1):
        part = given[a * size : (a + 1) * size]
        for k in range(size):
            flat[k] += part[k]
        for j in range(n_atoms):
            bias[j] += head_bias[a * n_atoms + j]
    share = np.float32(1.0 / n_actions)
    for k in range(size):
        flat[k] = given[k] - share * flat[k]
    for j in range(n_atoms):
        bias[j] = head_bias[j] - share * bias[j]


@njit(cache=True)
def by_action(
    actions: NDArray[np.int64], n_actions: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Samples sorted by their action, and where those of each action end, for one matrix product
    an action in the place of a loop over samples.
    """
    order, ends = np.empty(actions.shape[0], np.int64), np.zeros(n_actions, np.int64)
    for b in range(actions.shape[0]):
        if not 0 <= actions[b] < n_actions:
            raise IndexError("the replay buffer holds an action outside of the action space")
        ends[actions[b]] += 1
    total = 0
    for a in range(n_actions):  # where they begin, at first
        total, ends[a] = total + ends[a], total
    for b in range(actions.shape[0]):
        order[ends[actions[b]]] = b
        ends[actions[b]] += 1
    return order, ends


@njit(cache=True)
def rows_of(matrix: Matrix, order: NDArray[np.int64]) -> Matrix:
    """A copy of rows, in another order."""
    result = np.empty(matrix.shape, np.float32)
    for k in range(order.shape[0]):
        row, given = result[k], matrix[order[k]]
        for i in range(row.shape[0]):
            row[i] = given[i]
    return result


@njit(cache=True, fastmath=FAST, error_model="numpy")
def taken_logits(
    parameters: Vector,
    effective: Vector,
    table: Table,
    units: Matrix,
    actions: NDArray[np.int64],
    dueling: bool,
    common: Matrix,
    logits: Matrix,
) -> None:
    """Write the ``logits`` ``(B, n_atoms)`` of one action per sample, with twelve actions a twelfth
    of the head's arithmetic, and to ``common`` the part of the weights that all actions share.
    """
    weight, bias = weights_of(parameters, effective, table, table.shape[0] - 1)
    n_atoms = common.shape[0]
    common_bias = np.empty(n_atoms, np.float32)
    shared_weight(weight, bias, dueling, common, common_bias)
    np.dot(units, common.T, logits)
    first_stream = 1 if dueling else 0
    order, ends = by_action(actions, bias.shape[0] // n_atoms - first_stream)
    sorted_units, own = rows_of(units, order), np.empty(logits.shape, np.float32)
    start = 0
    for a in range(ends.shape[0]):
        first, end = (a + first_stream) * n_atoms, ends[a]
        if end > start:
            part = weight[first : first + n_atoms]
            np.dot(sorted_units[start:end], part.T, own[start:end])
        for k in range(start, end):
            row, given = logits[order[k]], own[k]
            for j in range(n_atoms):
                row[j] += given[j] + common_bias[j] + bias[first + j]
        start = end
