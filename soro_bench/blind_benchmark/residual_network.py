"""A black box for what a simulation leaves: a network from the commands and the simulated robot to the residual."""

import numpy as np

from soro_bench.diagnosis.robots.measured import Measured
from soro_bench.diagnosis.robots.robot import Robot

HISTORY = 10  # control steps of commands that it sees
HIDDEN, EPOCHS, PATIENCE, LEARNING_RATE, DECAY = 128, 2000, 100, 1e-3, 1e-3
_VALIDATION = 0.2  # of the recording, its end


def residual_rms(robot: Robot, x: np.ndarray, train: Measured, other: Measured) -> tuple[float, float]:
    """rms [signal's unit] of a coordinate on another recording, without and with the network.

    Args:
        x: (d,) parameters of the simulation, in standard deviations of their priors.
        train, other: what it is trained on, and what it is tried on.
    """
    parameters = np.array([[prior.value(value) for prior, value in zip(robot.priors, x, strict=True)]])
    inputs, left = [], []
    for each in (train, other):
        (simulated,) = robot.simulate(each.actions, parameters, [()], each.start)
        left.append((each.values - simulated).reshape(len(each.values), -1))
        inputs.append(_inputs(each.actions, simulated))
    predicted = _predicted(inputs[0], left[0], inputs[1])
    without, with_network = (float(np.sqrt(np.nanmean(rows**2))) for rows in (left[1], left[1] - predicted))
    return without, with_network


def _inputs(actions: np.ndarray, simulated: np.ndarray) -> np.ndarray:
    """(T, k) commands of the last steps, where they led to, and the simulated signal."""
    padded = np.concatenate([np.zeros((HISTORY - 1, actions.shape[1])), actions])
    past = np.lib.stride_tricks.sliding_window_view(padded, HISTORY, axis=0).reshape(len(actions), -1)
    return np.concatenate([past, np.cumsum(actions, axis=0), simulated.reshape(len(actions), -1)], axis=1)


def _predicted(inputs: np.ndarray, targets: np.ndarray, asked: np.ndarray) -> np.ndarray:
    """What a network that was trained until it did not get better on the end of the recording says of ``asked``."""
    import torch

    torch.manual_seed(0)
    torch.set_num_threads(1)  # sums would depend on the number
    known = np.isfinite(targets).all(axis=1)
    inputs, targets = inputs[known], targets[known]
    (centre, width), (mean, size) = ((a.mean(axis=0), a.std(axis=0) + 1e-9) for a in (inputs, targets))
    cut = round((1 - _VALIDATION) * len(inputs))
    x, y, new = (torch.tensor(a, dtype=torch.float32) for a in ((inputs - centre) / width, (targets - mean) / size,
                                                               (asked - centre) / width))  # fmt: skip
    network = torch.nn.Sequential(torch.nn.Linear(x.shape[1], HIDDEN), torch.nn.Tanh(),
                                  torch.nn.Linear(HIDDEN, y.shape[1]))  # fmt: skip
    optimizer = torch.optim.AdamW(network.parameters(), lr=LEARNING_RATE, weight_decay=DECAY)
    best, answer, waited = float("inf"), np.zeros((len(asked), targets.shape[1])), 0
    for _ in range(EPOCHS):
        optimizer.zero_grad()
        ((network(x[:cut]) - y[:cut]) ** 2).mean().backward()
        optimizer.step()
        with torch.no_grad():
            loss, waited = float(((network(x[cut:]) - y[cut:]) ** 2).mean()), waited + 1
            if loss < best:
                best, answer, waited = loss, network(new).numpy() * size + mean, 0
        if waited > PATIENCE:
            break
    return answer
