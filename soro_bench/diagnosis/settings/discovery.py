"""How laws outside the catalogue are found."""

from dataclasses import dataclass

from soro_bench.diagnosis.settings.setting import setting


@dataclass(frozen=True)
class DiscoverySettings:
    """Laws at the located place: from a grammar of terms to one that holds on held-out motion."""

    locations: int = setting(3, "locations", "where a law is looked for, the best ones; nearby ones look alike")
    location_share: float = setting(0.8, "1", "of the best location's gain, below which none is looked at")
    elements: int = setting(12, "elements", "of each kind that a law may read, the nearest first")
    times: tuple[float, ...] = setting((0.1, 0.3, 1.0), "s", "of lags and Maxwell elements, to begin with")
    widths: tuple[float, ...] = setting((0.05, 0.2), "1", "of a range, of play and hysteresis, to begin with")
    waves: tuple[float, ...] = setting((1.0, 1.5, 2.0, 3.0), "periods", "in a range of position, to begin with")
    frequencies: int = setting(3, "peaks", "of the input's spectrum that a periodic law may have")
    smoothings: tuple[float, ...] = setting(
        (0.005, 0.02), "1", "of a range of velocity, in which the sign of a law changes, to begin with"
    )
    singles: int = setting(6, "laws", "of one term that are replayed")
    pairs: int = setting(5, "laws", "of two terms that are replayed")
    triples: int = setting(2, "laws", "of three terms that are replayed")
    fitted: tuple[int, ...] = setting(
        (3, 2, 1), "laws", "of one, two and three terms that are fitted, those that leave least with regressed values"
    )
    last: int = setting(2, "laws", "that are fitted once more, those that leave least of held-out motion")
    least_share: float = setting(0.02, "1", "of what the input explains, that a further term has to")
    deviation: float = setting(2.0, "1", "of a coefficient's prior, times its regressed value")
    shape_deviation: float = setting(0.4, "1", "of a shape's prior: of its logarithm, or of its typical size")
    least_explained: float = setting(0.3, "1", "of held-out variance above the noise; less is no law")
    same: float = setting(0.1, "1", "of the misfit, by which a law may leave more than another and be as good")
    beats: float = setting(0.6, "1", "of the catalogue's misfit, below which a law replaces its best answer")
    limit: float = setting(3.0, "1", "times the largest force that was seen, which a law never exceeds")
