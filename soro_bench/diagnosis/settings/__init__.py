"""Every number that the diagnosis method was given, with its unit and its reason.

There is one frozen dataclass per stage, and ``Settings`` holds one of each. A problem carries the settings of its
diagnosis (``Problem.settings``). Functions without a problem take the settings of their stage as an argument.

``benchmarks/diagnosis_settings.py`` and ``benchmarks/settings_tests.py`` halve and double each value in turn; their
results are in docs/reference/settings.md.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from typing import Any

from soro_bench.diagnosis.settings.data import DataQualitySettings
from soro_bench.diagnosis.settings.estimation import (
    AgreementSettings,
    DescentSettings,
    DiscretisationSettings,
    FitSettings,
    LikelihoodSettings,
    PriorSettings,
    RobotSettings,
)
from soro_bench.diagnosis.settings.search import (
    DiscoverySettings,
    ExperimentDesignSettings,
    LimitSettings,
    LocalisationSettings,
    PairedSettings,
    ProbabilitySettings,
    ReportSettings,
    ScreeningSettings,
    SelectionSettings,
)
from soro_bench.diagnosis.settings.setting import listed, setting

__all__ = [
    "DEFAULT",
    "AgreementSettings",
    "DataQualitySettings",
    "DescentSettings",
    "DiscoverySettings",
    "DiscretisationSettings",
    "ExperimentDesignSettings",
    "FitSettings",
    "LikelihoodSettings",
    "LimitSettings",
    "LocalisationSettings",
    "PairedSettings",
    "PriorSettings",
    "ProbabilitySettings",
    "ReportSettings",
    "RobotSettings",
    "ScreeningSettings",
    "SelectionSettings",
    "Settings",
    "listed",
    "setting",
]


@dataclass(frozen=True)
class Settings:
    """The settings of a diagnosis, one group per stage."""

    data_quality: DataQualitySettings = field(default_factory=DataQualitySettings)
    discretisation: DiscretisationSettings = field(default_factory=DiscretisationSettings)
    likelihood: LikelihoodSettings = field(default_factory=LikelihoodSettings)
    priors: PriorSettings = field(default_factory=PriorSettings)
    fit: FitSettings = field(default_factory=FitSettings)
    descent: DescentSettings = field(default_factory=DescentSettings)
    screening: ScreeningSettings = field(default_factory=ScreeningSettings)
    selection: SelectionSettings = field(default_factory=SelectionSettings)
    probabilities: ProbabilitySettings = field(default_factory=ProbabilitySettings)
    localisation: LocalisationSettings = field(default_factory=LocalisationSettings)
    discovery: DiscoverySettings = field(default_factory=DiscoverySettings)
    agreement: AgreementSettings = field(default_factory=AgreementSettings)
    experiment_design: ExperimentDesignSettings = field(default_factory=ExperimentDesignSettings)
    limits: LimitSettings = field(default_factory=LimitSettings)
    report: ReportSettings = field(default_factory=ReportSettings)
    paired: PairedSettings = field(default_factory=PairedSettings)

    def groups(self) -> dict[str, Any]:
        """The settings of every stage, by its name."""
        return {stage.name: getattr(self, stage.name) for stage in fields(self)}

    def listed(self) -> Iterator[tuple[str, str, Any, str, str]]:
        """Stage, name, value, unit and reason of every setting."""
        for stage, group in self.groups().items():
            yield from listed(stage, group)


DEFAULT = Settings()
