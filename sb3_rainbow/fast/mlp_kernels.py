"""Forward and backward of Rainbow's multilayer perceptron, written out for one processor core.

All arrays are float32 and C-ordered; matrices of weights are ``(outputs, inputs)``. A network is
one vector of parameters with a table of where each layer lies in it, one row per layer:

    inputs, outputs, noisy (0 or 1), offset among the parameters, offset among the noise, offset
    among the effective weights, offset (per sample) among the hidden units

A layer's parameters are weight and bias, or, where it is noisy, the means of the weight, its
sigmas, then those of the bias. Its effective weight and bias include the noise of the moment.
"""

import math

import numpy as np
from numpy.typing import NDArray

from sb3_rainbow.compilation import njit

INPUTS, OUTPUTS, NOISY, PARAMETERS, NOISE, EFFECTIVE, HIDDEN = range(7)

Vector = NDArray[np.float32]
Matrix = NDArray[np.float32]
Table = NDArray[np.int64]
# Sums may be reordered, so that they run in vector registers; NaN and infinity stay themselves. The
# check for a division by zero (error_model) would forbid vector registers as well.
_FAST = {"reassoc", "contract", "nsz", "arcp"}


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def effective_weights(parameters: Vector, noise: Vector, table: Table, effective: Vector) -> None:
    """``mu + sigma * epsilon`` for all layers."""
    for layer in range(table.shape[0]):
        n_in, n_out = table[layer, INPUTS], table[layer, OUTPUTS]
        size = n_in * n_out
        p, e = table[layer, PARAMETERS], table[layer, EFFECTIVE]
        if table[layer, NOISY] == 0:
            effective[e : e + size + n_out] = parameters[p : p + size + n_out]
            continue
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


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def parameter_gradients(gradient: Vector, noise: Vector, table: Table, out: Vector) -> None:
    """Gradients of the parameters from those of the effective weights."""
    for layer in range(table.shape[0]):
        n_in, n_out = table[layer, INPUTS], table[layer, OUTPUTS]
        size = n_in * n_out
        p, e = table[layer, PARAMETERS], table[layer, EFFECTIVE]
        if table[layer, NOISY] == 0:
            out[p : p + size + n_out] = gradient[e : e + size + n_out]
            continue
        first = table[layer, NOISE]
        epsilon_in = noise[first : first + n_in]
        out[p : p + size] = gradient[e : e + size]
        bias = p + 2 * size
        for j in range(n_out):
            epsilon_out = noise[first + n_in + j]
            row = gradient[e + j * n_in : e + (j + 1) * n_in]
            sigma = out[p + size + j * n_in : p + size + (j + 1) * n_in]
            for i in range(n_in):
                sigma[i] = row[i] * (epsilon_out * epsilon_in[i])
            out[bias + j] = gradient[e + size + j]
            out[bias + n_out + j] = gradient[e + size + j] * epsilon_out


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def hidden_units(effective: Vector, table: Table, inputs: Matrix, hidden: Vector) -> Matrix:
    """ReLU layers up to the head; ``hidden`` keeps every layer's outputs, the last is returned."""
    batch = inputs.shape[0]
    current = inputs
    for layer in range(table.shape[0] - 1):
        n_in, n_out = table[layer, INPUTS], table[layer, OUTPUTS]
        e, h = table[layer, EFFECTIVE], table[layer, HIDDEN] * batch
        weight = effective[e : e + n_in * n_out].reshape((n_out, n_in))
        bias = effective[e + n_in * n_out : e + n_in * n_out + n_out]
        outputs = hidden[h : h + batch * n_out].reshape((batch, n_out))
        np.dot(current, weight.T, outputs)
        for b in range(batch):
            for j in range(n_out):
                outputs[b, j] = max(outputs[b, j] + bias[j], np.float32(0.0))
        current = outputs
    return current


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def all_logits(
    effective: Vector, table: Table, units: Matrix, dueling: bool, value: Matrix, logits: Matrix
) -> None:
    """
    The head's logits for every action, each action's shifted to a maximum of zero.

    :param value: scratch for the value stream, ``(B, n_atoms)``
    :param logits: result, ``(B, n_actions * n_atoms)``
    """
    head = table[table.shape[0] - 1]
    n_in, n_out, e = head[INPUTS], head[OUTPUTS], head[EFFECTIVE]
    n_atoms, n_logits = value.shape[1], logits.shape[1]
    skipped = n_atoms if dueling else 0
    weight = effective[e : e + n_in * n_out].reshape((n_out, n_in))
    bias = effective[e + n_in * n_out : e + n_in * n_out + n_out]
    np.dot(units, weight[skipped:].T, logits)
    if dueling:
        np.dot(units, weight[:n_atoms].T, value)
    share = np.float32(n_atoms / n_logits)
    shift = np.empty(n_atoms, np.float32)
    for b in range(units.shape[0]):
        row = logits[b]
        for j in range(n_logits):
            row[j] += bias[skipped + j]
        shift[:] = 0.0
        if dueling:
            for first in range(0, n_logits, n_atoms):
                for j in range(n_atoms):
                    shift[j] += row[first + j]
            for j in range(n_atoms):
                shift[j] = value[b, j] + bias[j] - share * shift[j]
        for first in range(0, n_logits, n_atoms):
            part = row[first : first + n_atoms]
            top = part[0] + shift[0]
            for j in range(n_atoms):
                part[j] += shift[j]
                top = max(top, part[j])
            if n_atoms > 1:
                for j in range(n_atoms):
                    part[j] -= top


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def best_actions(
    masses: Matrix, support: Vector, masks: NDArray[np.bool_], actions: NDArray[np.int64]
) -> None:
    """
    The allowed action of the highest expectation.

    :param masses: proportional to the atoms' probabilities, ``(B, n_actions * n_atoms)``; with one
        atom, the values themselves
    :param masks: ``(B, n_actions)``, or ``(0, 0)`` to allow everything
    :param actions: result, ``(B,)``
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
                    total += part[j]
                    moment += part[j] * support[j]
                expectation = moment / total
            if chosen < 0 or expectation > best:
                best, chosen = expectation, a
        actions[b] = chosen


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def shared_weight(
    effective: Vector, table: Table, n_atoms: int, dueling: bool, weight: Matrix, bias: Vector
) -> None:
    """What every action has in common, ``W_V - mean W_A``; zero without dueling."""
    weight[:] = 0.0
    bias[:] = 0.0
    if not dueling:
        return
    head = table[table.shape[0] - 1]
    n_in, n_out, e = head[INPUTS], head[OUTPUTS], head[EFFECTIVE]
    n_actions = n_out // n_atoms - 1
    size = n_atoms * n_in
    flat = weight.reshape(size)
    for a in range(1, n_actions + 1):
        start = e + a * size
        for k in range(size):
            flat[k] += effective[start + k]
        for j in range(n_atoms):
            bias[j] += effective[e + n_in * n_out + a * n_atoms + j]
    share = np.float32(1.0 / n_actions)
    for k in range(size):
        flat[k] = effective[e + k] - share * flat[k]
    for j in range(n_atoms):
        bias[j] = effective[e + n_in * n_out + j] - share * bias[j]


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def taken_logits(
    effective: Vector,
    table: Table,
    units: Matrix,
    actions: NDArray[np.int64],
    dueling: bool,
    common: Matrix,
    common_bias: Vector,
    logits: Matrix,
) -> None:
    """Logits of one action per sample: a twelfth of the head's arithmetic for twelve actions."""
    head = table[table.shape[0] - 1]
    n_in, n_out, e = head[INPUTS], head[OUTPUTS], head[EFFECTIVE]
    n_atoms = logits.shape[1]
    np.dot(units, common.T, logits)
    first_stream = 1 if dueling else 0
    for b in range(units.shape[0]):
        first = (actions[b] + first_stream) * n_atoms
        unit = units[b]
        for j in range(n_atoms):
            start = e + (first + j) * n_in
            row = effective[start : start + n_in]
            total = np.float32(0.0)
            for i in range(n_in):
                total += row[i] * unit[i]
            logits[b, j] += total + common_bias[j] + effective[e + n_in * n_out + first + j]


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def backward(
    effective: Vector,
    table: Table,
    inputs: Matrix,
    hidden: Vector,
    actions: NDArray[np.int64],
    dueling: bool,
    common: Matrix,
    slope: Matrix,
    gradient: Vector,
) -> None:
    """
    Gradient of the effective weights from that of the taken logits, ``slope`` ``(B, n_atoms)``.
    """
    batch, n_atoms = slope.shape
    n_layers = table.shape[0]
    head = table[n_layers - 1]
    n_in, n_out, e = head[INPUTS], head[OUTPUTS], head[EFFECTIVE]
    units = inputs
    if n_layers > 1:
        start = table[n_layers - 2, HIDDEN] * batch
        units = hidden[start : start + batch * n_in].reshape((batch, n_in))
    size = n_atoms * n_in
    n_streams = n_out // n_atoms
    bias = gradient[e + n_in * n_out : e + n_in * n_out + n_out]
    gradient[e : e + n_in * n_out] = 0.0
    bias[:] = 0.0
    first_stream = 0
    if dueling:
        first_stream = 1
        value = gradient[e : e + size]
        np.dot(slope.T, units, value.reshape((n_atoms, n_in)))
        for b in range(batch):
            for j in range(n_atoms):
                bias[j] += slope[b, j]
        share = np.float32(-1.0 / (n_streams - 1))
        for a in range(1, n_streams):
            for k in range(size):
                gradient[e + a * size + k] = share * value[k]
            for j in range(n_atoms):
                bias[a * n_atoms + j] = share * bias[j]
    delta = np.dot(slope, common)
    for b in range(batch):
        first = (actions[b] + first_stream) * n_atoms
        unit, back = units[b], delta[b]
        for j in range(n_atoms):
            s = slope[b, j]
            start = e + (first + j) * n_in
            row = effective[start : start + n_in]
            out = gradient[start : start + n_in]
            for i in range(n_in):
                out[i] += s * unit[i]
                back[i] += s * row[i]
            bias[first + j] += s
    for layer in range(n_layers - 2, -1, -1):
        n_in, n_out = table[layer, INPUTS], table[layer, OUTPUTS]
        e, h = table[layer, EFFECTIVE], table[layer, HIDDEN] * batch
        outputs = hidden[h : h + batch * n_out].reshape((batch, n_out))
        layer_bias = gradient[e + n_in * n_out : e + n_in * n_out + n_out]
        layer_bias[:] = 0.0
        for b in range(batch):
            for j in range(n_out):
                if outputs[b, j] <= 0.0:
                    delta[b, j] = 0.0
                layer_bias[j] += delta[b, j]
        below = inputs
        if layer > 0:
            start = table[layer - 1, HIDDEN] * batch
            below = hidden[start : start + batch * n_in].reshape((batch, n_in))
        np.dot(delta.T, below, gradient[e : e + n_in * n_out].reshape((n_out, n_in)))
        if layer > 0:
            delta = np.dot(delta, effective[e : e + n_in * n_out].reshape((n_out, n_in)))


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def shift_to_zero(logits: Matrix) -> None:
    """Subtract each row's maximum, so that no exponential overflows."""
    for b in range(logits.shape[0]):
        row = logits[b]
        top = row[0]
        for j in range(row.shape[0]):
            top = max(top, row[j])
        for j in range(row.shape[0]):
            row[j] -= top


@njit(cache=True, error_model="numpy")
def projected_target(
    masses: Matrix,
    returns: Matrix,
    discounts: Matrix,
    dones: Matrix,
    v_min: float,
    v_max: float,
    target: Matrix,
) -> None:
    """
    As :func:`~sb3_rainbow.network.losses.project_distribution`.

    :param masses: proportional to the atoms' probabilities at t + k, ``(B, n_atoms)``
    :param target: result, ``(B, n_atoms)``; NaN where a return or discount is no number
    """
    batch, n_atoms = masses.shape
    delta_z = (v_max - v_min) / (n_atoms - 1)
    target[:] = 0.0
    for b in range(batch):
        discount = discounts[b, 0] * (1.0 - dones[b, 0])
        if math.isnan(returns[b, 0]) or not math.isfinite(discount):
            # Positions that are no number would be indices outside of the array.
            target[b] = np.nan
            continue
        total = np.float32(0.0)
        for j in range(n_atoms):
            total += masses[b, j]
        for j in range(n_atoms):
            z = returns[b, 0] + discount * (v_min + j * delta_z)
            position = (min(max(z, v_min), v_max) - v_min) / delta_z
            lower = min(int(position), n_atoms - 2)
            mass = masses[b, j] / total
            upper_mass = mass * min(position - lower, 1.0)
            target[b, lower] += mass - upper_mass
            target[b, lower + 1] += upper_mass


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def categorical_slopes(
    logits: Matrix,
    masses: Matrix,
    target: Matrix,
    log_target: Matrix,
    weights: Vector,
    losses: Vector,
    divergences: Vector,
    slope: Matrix,
) -> None:
    """
    Cross-entropies, Kullback-Leibler divergences, and the slope of the cross-entropies' weighted
    mean in the logits.

    :param logits: up to a constant per row, ``(B, n_atoms)``
    :param masses: their exponentials
    :param log_target: logarithm of ``target``; finite where that is 0
    """
    batch, n_atoms = logits.shape
    for b in range(batch):
        total = np.float32(0.0)
        for j in range(n_atoms):
            total += masses[b, j]
        log_total = np.float32(math.log(total))
        scale = np.float32(weights[b] / batch)
        share = scale / total
        loss = entropy = np.float32(0.0)
        for j in range(n_atoms):
            t = target[b, j]
            loss -= t * (logits[b, j] - log_total)
            entropy -= t * log_target[b, j]
            slope[b, j] = masses[b, j] * share - t * scale
        losses[b] = loss
        divergences[b] = max(loss - entropy, np.float32(0.0))


@njit(cache=True, error_model="numpy")
def huber_slopes(
    values: Matrix,
    target_values: Matrix,
    returns: Matrix,
    discounts: Matrix,
    dones: Matrix,
    weights: Vector,
    losses: Vector,
    errors: Vector,
    slope: Matrix,
) -> None:
    """Huber losses, absolute errors, and the slope of the losses' weighted mean in the values."""
    batch = values.shape[0]
    for b in range(batch):
        target = returns[b, 0] + discounts[b, 0] * (1.0 - dones[b, 0]) * target_values[b, 0]
        error = values[b, 0] - target
        errors[b] = abs(error)
        losses[b] = 0.5 * error * error if abs(error) < 1.0 else abs(error) - 0.5
        slope[b, 0] = min(max(error, -1.0), 1.0) * (weights[b] / batch)


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def adam_step(
    parameters: Vector,
    gradient: Vector,
    first: Vector,
    second: Vector,
    max_norm: float,
    lr: float,
    beta1: float,
    beta2: float,
    epsilon: float,
    weight_decay: float,
    step: float,
) -> None:
    """Clip the gradient to ``max_norm`` (in place), then one step of Adam with L2 decay."""
    square = np.float32(0.0)
    for i in range(gradient.shape[0]):
        square += gradient[i] * gradient[i]
    scale = np.float32(min(1.0, max_norm / (math.sqrt(square) + 1e-6)))
    b1, b2, decay = np.float32(beta1), np.float32(beta2), np.float32(weight_decay)
    one = np.float32(1.0)
    size = np.float32(lr / (1.0 - beta1**step))
    correction = np.float32(1.0 / math.sqrt(1.0 - beta2**step))
    small = np.float32(epsilon)
    for i in range(gradient.shape[0]):
        gradient[i] *= scale
        g = gradient[i] + decay * parameters[i]
        first[i] += (one - b1) * (g - first[i])
        second[i] = b2 * second[i] + (one - b2) * g * g
        parameters[i] -= size * first[i] / (np.float32(math.sqrt(second[i])) * correction + small)
