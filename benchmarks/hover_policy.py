"""Policy of the hover study: a small recurrent network, and the expert whose commands it learns.

The expert knows where the drone is and how fast it flies. The network learns its commands while the network flies
(dataset aggregation, DAgger: Ross et al., AISTATS 2011), so that it learns from its own mistakes.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from benchmarks.hover_drones import BINS, GRAVITY, MOST_TILT, SIDE, Flight

STIFFNESS = 2.5
"""Acceleration of the expert for each metre from the middle [1/s²]."""
DAMPING = 3.0
"""Acceleration of the expert against each m/s [1/s]."""
HIDDEN = 128


def expert(flight: Flight) -> Tensor:
    """Return the tilt that brings drones back to the middle, and to rest [rad], shape (drones, 2)."""
    wanted = -STIFFNESS * flight.place - DAMPING * flight.speed
    return torch.atan(wanted / GRAVITY).clamp(-MOST_TILT, MOST_TILT)


class Policy(nn.Module):
    """Network that commands the tilt of drones from events: convolutions, then a memory."""

    def __init__(self) -> None:
        """Start with random weights."""
        super().__init__()
        self.seeing = nn.Sequential(
            nn.Conv2d(BINS, 16, 5, stride=2, padding=2),
            nn.ReLU(),
            nn.Conv2d(16, 32, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Conv2d(32, 32, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Flatten(),
            nn.Linear(32 * (SIDE // 8) ** 2, HIDDEN),
            nn.ReLU(),
        )
        self.memory = nn.GRUCell(HIDDEN + 4, HIDDEN)
        self.command = nn.Linear(HIDDEN, 2)
        self.where = nn.Linear(HIDDEN, 4)

    def start(self, drones: int, device: str) -> Tensor:
        """Return the memory of drones that have seen nothing."""
        return torch.zeros((drones, HIDDEN), device=device)

    def forward(
        self, grids: Tensor, known: Tensor, memory: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the commands [rad], the guesses of place and velocity [m, m/s], and the new memory."""
        seen = self.seeing(grids.clamp(-4.0, 4.0))
        memory = self.memory(torch.cat([seen, known], dim=1), memory)
        return MOST_TILT * torch.tanh(self.command(memory)), self.where(memory), memory
