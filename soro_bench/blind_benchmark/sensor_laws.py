"""Hidden faults of the measurement: when keypoints are sampled, and what is made of the samples."""

from dataclasses import dataclass

import numpy as np


class SensorLaw:
    """A fault of the measurement; it changes nothing where its magnitude is zero."""

    def when(self, stamps: np.ndarray) -> np.ndarray:
        """(n,) s, the times on the robot's clock at which the samples with these time stamps were taken."""
        return stamps

    def distort(self, stamps: np.ndarray, points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """(n, 21, 3) m, what is recorded instead of ``points``."""
        return points


@dataclass
class SensorDelay(SensorLaw):
    """Samples are stamped late."""

    delay: float  # s

    def when(self, stamps: np.ndarray) -> np.ndarray:
        return stamps - self.delay


@dataclass
class ClockSkew(SensorLaw):
    """The sensor's clock is slow by a share of the time."""

    skew: float

    def when(self, stamps: np.ndarray) -> np.ndarray:
        return stamps * (1 + self.skew)


@dataclass
class SensorBias(SensorLaw):
    """One keypoint is off, from a time on."""

    keypoint: int
    offset: np.ndarray  # (3,) m
    start: float = 0.0  # s

    def distort(self, stamps: np.ndarray, points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        points = points.copy()
        points[stamps >= self.start, self.keypoint] += self.offset
        return points


@dataclass
class Misalignment(SensorLaw):
    """The sensor's frame is turned about the clamp."""

    angle: float  # rad
    axis: np.ndarray  # (3,)

    def distort(self, stamps: np.ndarray, points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        along = (points @ self.axis)[..., None] * self.axis
        across = np.cross(self.axis, points)
        return along + np.cos(self.angle) * (points - along) + np.sin(self.angle) * across


@dataclass
class Outliers(SensorLaw):
    """Some samples of some keypoints are elsewhere."""

    size: float  # m, standard deviation of each coordinate
    share: float  # of the samples of keypoints

    def distort(self, stamps: np.ndarray, points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        hit = rng.random(points.shape[:2]) < self.share
        return points + self.size * hit[..., None] * rng.standard_normal(points.shape)
