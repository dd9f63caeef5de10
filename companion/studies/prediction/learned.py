"""Learned predictor: an LSTM over the last reports. Only this module loads PyTorch.

In the manner of LRNet (C. Liu, W. Yuan, Z. Wei, X. Liu, D. W. K. Ng, "Location-aware predictive
beamforming for UAV communications: a deep learning approach", IEEE Wireless Communications Letters
10(3), 668-672): the last locations enter a recurrent network, whose state a dense layer maps to the
future location. Only the citation and a reader's sketch of the network were available, not the
paper, and this differs on purpose: reports come at any intervals (so their times are an input),
they contain velocities, any lead is possible (it is an input of the dense layers), and the network
learns the deviation from straight flight, as an acceleration:

    p(t + h) = p(t) + v(t) h + R a(window, h) h^2 / 2          h up to ``LEAD_MAX_S``

Beyond that the acceleration ends and the flight is straight. Trained on random flights over random
links; the same seed gives the same network on the same machine.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
import torch
from torch import nn

from companion.studies.origin import Progress, silent
from companion.studies.prediction import made_up
from companion.studies.prediction.baselines import ObservedReport, Predicted, Predictor
from companion.studies.prediction.delivery import deliver
from companion.studies.prediction.windows import FEATURES, REPORTS, RecentReports, Window
from companion.values import FloatArray, UserError

FORMAT: Final = "companion lstm 1"
HIDDEN: Final = 48
LEAD_MAX_S: Final = 4.0  # longest time since the newest report for which the network was trained
ACCELERATION_UNIT_MPS2: Final = 2.0
BATCH: Final = 256
RATE: Final = 3e-3
FLIGHTS: Final = 240
LEADS_A_WINDOW: Final = 4

Network: TypeAlias = Any
"""Type of a network, ``torch.nn.ModuleDict``, which exists only with PyTorch."""


def network() -> Network:
    """Return an untrained network, its weights drawn from torch's generator."""
    head = nn.Sequential(nn.Linear(HIDDEN + 1, HIDDEN), nn.Tanh(), nn.Linear(HIDDEN, 3))
    return nn.ModuleDict({"lstm": nn.LSTM(FEATURES, HIDDEN, batch_first=True), "head": head})


def _accelerations(net: Network, state: Any, lead_s: Any) -> Any:
    """Return accelerations (B, 3), window's frame, m/s², for states (B, HIDDEN), leads (B, 1)."""
    return net["head"](torch.cat([state, lead_s / LEAD_MAX_S], dim=1)) * ACCELERATION_UNIT_MPS2


# --- predicting ---------------------------------------------------------------------------------


class Learned:
    """Predictor of one UAV by a trained LSTM network."""

    def __init__(self, net: Network) -> None:
        self._net = net
        self._recent = RecentReports()
        self._window: Window | None = None
        self._state: Any = None

    def report(self, report: ObservedReport) -> None:
        """Add a report; the recurrent part of the network runs once per report."""
        if self._recent.add(report):
            self._window = self._recent.window()
            seen = torch.tensor(self._window.seen[None], dtype=torch.float32)
            with torch.no_grad():
                self._state = self._net["lstm"](seen)[1][0][0]

    def predict(self, now_ns: int, at_ns: int) -> Predicted | None:
        """Return dead reckoning from the newest report, plus the network's correction."""
        window = self._window
        if window is None:
            return None
        since_s = (at_ns - self._recent.offset_ns - window.sender_ns) * 1e-9
        lead_s = min(max(since_s, 0.0), LEAD_MAX_S)
        with torch.no_grad():
            seen = _accelerations(self._net, self._state, torch.tensor([[lead_s]]))[0].numpy()
        acceleration = window.local_from_seen @ seen.astype(float)
        # Past the largest lead: straight flight at the velocity reached there.
        bend = acceleration * (lead_s * lead_s / 2 + lead_s * (max(since_s, lead_s) - lead_s))
        position = window.position_ned_m + window.velocity_ned_mps * since_s + bend
        velocity = window.velocity_ned_mps + acceleration * lead_s
        return Predicted(position_ned_m=position, velocity_ned_mps=velocity)


def load(path: Path) -> Callable[[], Predictor]:
    """Return a factory of predictors with a trained network.

    Raises ``UserError`` for a file without a network, ``OSError`` if it cannot be read.
    """
    torch.set_num_threads(1)
    net = network()
    try:
        held = torch.load(path, weights_only=True, map_location="cpu")
        if not isinstance(held, dict) or held.get("format") != FORMAT:
            raise UserError("wrong format")
        net.load_state_dict(held["weights"])
    except OSError:
        raise
    except Exception as error:  # an invalid pickle can raise anything
        raise UserError(f"{path}: not a network of `companion study train`") from error
    net.eval()
    return lambda: Learned(net)


# --- learning -----------------------------------------------------------------------------------


def examples(
    seed: int, flights: int, progress: Progress
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return training examples: windows of K reports with a known future.

    Windows (N, K, 7), leads (N, L) in s, and deviations (N, L, 3) of the UAV from straight flight,
    frame of the window, m.
    """
    rng = np.random.default_rng(seed)
    windows: list[FloatArray] = []
    leads: list[FloatArray] = []
    ways: list[FloatArray] = []
    for number in range(flights):
        if number % 20 == 0:
            progress(f"flight {number} of {flights}")
        made = made_up.flight(rng, f"{number}:1")
        observed = deliver(made, made_up.link(rng), seed).observed
        if not observed:
            continue
        sender_ns = np.array([each.sender_ns for each in observed])
        true_ns = made_up.made_ns(made, sender_ns, observed[0].position_ned_m)
        recent = RecentReports()
        for each in observed:
            if not recent.add(each):
                continue
            window = recent.window()
            if len(window.seen) < REPORTS:
                continue
            lead_s = rng.uniform(0.0, LEAD_MAX_S, LEADS_A_WINDOW)
            from_ns = true_ns[0] + window.sender_ns - sender_ns[0]
            place, _ = made.truth.at(from_ns + np.round(lead_s * 1e9).astype(np.int64))
            straight = window.position_ned_m + window.velocity_ned_mps * lead_s[:, None]
            off = (place - straight) @ window.local_from_seen
            if not np.isnan(off).any():
                windows.append(window.seen)
                leads.append(lead_s)
                ways.append(off)
    return np.array(windows), np.array(leads), np.array(ways)


def train(
    seed: int = 1, epochs: int = 30, flights: int = FLIGHTS, progress: Progress = silent
) -> tuple[dict[str, Any], float]:
    """Train a network: return the input of ``save``, and the loss of the last epoch (Huber, m).

    Raises ``UserError`` if the flights give no example. Sets torch to one thread and to
    deterministic algorithms.
    """
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)
    torch.manual_seed(seed)
    seen, leads, ways = (
        torch.tensor(each, dtype=torch.float32) for each in examples(seed, flights, progress)
    )
    if len(seen) == 0:
        raise UserError("no training examples; give more flights")
    net = network()
    steps = epochs * -(-len(seen) // BATCH)
    optimiser = torch.optim.Adam(net.parameters(), lr=RATE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=steps)
    rng = np.random.default_rng([seed, 1])
    mean = float("nan")
    for epoch in range(epochs):
        order = torch.tensor(rng.permutation(len(seen)))
        total = 0.0
        for rows in torch.split(order, BATCH):
            # Sometimes fewer reports, as at the start of a flight.
            known = REPORTS if rng.random() < 0.7 else int(rng.integers(1, REPORTS))
            loss = _loss(net, seen[rows, REPORTS - known :], leads[rows], ways[rows])
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(net.parameters(), 1.0)
            optimiser.step()
            schedule.step()
            total += float(loss.detach()) * len(rows)
        mean = total / len(seen)
        progress(f"epoch {epoch + 1} of {epochs}: {mean:.3f} m")
    weights = net.state_dict()
    return {"format": FORMAT, "seed": seed, "epochs": epochs, "weights": weights}, mean


def _loss(net: Network, seen: Any, leads: Any, ways: Any) -> Any:
    """Return Huber's loss of the deviations, metres; squares would weigh long leads too much."""
    state = net["lstm"](seen)[1][0][0]
    state = state.repeat_interleave(LEADS_A_WINDOW, dim=0)
    lead_s = leads.reshape(-1, 1)
    bend = _accelerations(net, state, lead_s) * (lead_s * lead_s / 2)
    return nn.functional.huber_loss(bend, ways.reshape(-1, 3), delta=0.5)


def save(held: dict[str, Any], path: Path) -> None:
    """Write the result of ``train`` to a file."""
    torch.save(held, path)
