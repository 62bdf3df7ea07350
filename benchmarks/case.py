# SPDX-License-Identifier: Apache-2.0
"""A case and its figures; both travel between processes as JSON."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Self

__all__ = ["ALL", "QUICK", "Accuracy", "Case", "Figures", "Work"]


@dataclass(frozen=True)
class Case:
    """One line of the tables.

    Attributes:
        points: points of the input.
        ratio: output points an input point.
        repeats: timed runs, after one that is not timed.
        model: name of released weights, or the path of a ``.safetensors`` file.
    """

    points: int
    ratio: int
    repeats: int
    model: str = "standard"

    @property
    def name(self) -> str:
        """Such as ``5,000 x4``."""
        return f"{self.points:,} x{self.ratio}"

    def to_json(self) -> str:
        """The inverse of :meth:`from_json`."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Self:
        """The inverse of :meth:`to_json`."""
        return cls(**json.loads(text))


@dataclass(frozen=True)
class Accuracy:
    """Accuracy of a dense cloud: a fast method that misses the surface is not fast.

    Attributes:
        distance: mean distance to the true surface, in percent of the input's spacing.
        angle: mean angle between normal and true normal, degrees, sign ignored.
        evenness: standard deviation over mean of distances to the nearest neighbour.
    """

    distance: float
    angle: float
    evenness: float


@dataclass(frozen=True)
class Work:
    """Work of the network for each chart; every input point has one.

    Attributes:
        charts: charts of the cloud, those of the margins of tiles included.
        flops: floating-point operations of the matrix products, a chart.
        bytes: of all tensors that operations read and write, a chart.
        kind: data type of the products, one of ``Figures.gflops``.
    """

    charts: int
    flops: float
    bytes: float
    kind: str

    def seconds(self, gflops: Mapping[str, float]) -> float:
        """Seconds that the products for a chart take at the rate of their data type."""
        return self.flops / (1e9 * gflops[self.kind])


@dataclass(frozen=True)
class Figures:
    """Figures of one case.

    Attributes:
        case: the case.
        seconds: fastest timed run, bytes to bytes, wall clock.
        cpu_seconds: processor time of that run: what ``seconds`` would be if the core had been
            ours alone. Ratios are made of it.
        slowest: slowest timed run.
        stages: stage -> processor time of it in the fastest run, in the order they ran.
        points_out: points written.
        base_bytes: peak resident memory before the first run, with all libraries and the model.
        peak_bytes: peak resident memory after the last.
        accuracy: of our output.
        rival_cpu_seconds: processor time of the rival's fastest run, bytes to bytes.
        rival_accuracy: of its output.
        gflops: data type -> 10^9 operations a second of this core, fastest of three times around
            the runs: whoever shares the core can only make it slower.
        work: of the network.
    """

    case: Case
    seconds: float
    cpu_seconds: float
    slowest: float
    stages: dict[str, float]
    points_out: int
    base_bytes: int
    peak_bytes: int
    accuracy: Accuracy
    rival_cpu_seconds: float
    rival_accuracy: Accuracy
    gflops: dict[str, float]
    work: Work

    @property
    def rate(self) -> float:
        """Output points a second of processor time."""
        return self.points_out / self.cpu_seconds

    @property
    def rival_rate(self) -> float:
        """The rival's output points a second of processor time."""
        return self.points_out / self.rival_cpu_seconds

    @property
    def network_seconds(self) -> float:
        """Processor time of the stage ``network``, a chart."""
        return self.stages["predict"] / self.work.charts

    @property
    def roofline(self) -> float:
        """Share of the measured rate that the stage ``network`` reaches, 0 to 1."""
        return self.work.seconds(self.gflops) / self.network_seconds

    def to_json(self) -> str:
        """The inverse of :meth:`from_json`."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Self:
        """The inverse of :meth:`to_json`."""
        raw = json.loads(text)
        return cls(
            **{
                **raw,
                "case": Case(**raw["case"]),
                "accuracy": Accuracy(**raw["accuracy"]),
                "rival_accuracy": Accuracy(**raw["rival_accuracy"]),
                "work": Work(**raw["work"]),
            }
        )


ALL = (Case(5_000, 4, 9), Case(20_000, 4, 3), Case(100_000, 4, 2), Case(5_000, 16, 9))
QUICK = (Case(5_000, 4, 1), Case(20_000, 4, 1))
