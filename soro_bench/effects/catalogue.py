"""The catalogue: every effect by its name."""

from collections.abc import Sequence

from soro_bench.effects import bodies, contacts, custom, measurement, setpoints, springs, stiffness
from soro_bench.effects.effect import Effect, Quantity
from soro_bench.effects.law import Law
from soro_bench.effects.measurement import Fault

# in this order laws that change the same thing are applied
PHYSICS: dict[str, type[Law]] = {
    law.name: law
    for law in (
        stiffness.LocalStiffness,
        stiffness.StiffnessDrift,
        stiffness.MullinsSoftening,
        stiffness.Stiffening,
        stiffness.ViscousFriction,
        springs.PlasticSet,
        stiffness.RestBend,
        springs.Hysteresis,
        springs.ViscoelasticCreep,
        springs.CoulombFriction,
        springs.StribeckFriction,
        springs.LoadFriction,
        springs.GearFriction,
        springs.InputFriction,
        setpoints.ActuatorDelay,
        setpoints.ActuatorLag,
        setpoints.Backlash,
        setpoints.ActuatorDeadband,
        setpoints.ActuatorGain,
        setpoints.Pretension,
        setpoints.LostMotion,
        setpoints.PressureLeak,
        setpoints.PressureAsymmetry,
        setpoints.SupplyCoupling,
        setpoints.Compliance,
        setpoints.ActuatorSaturation,
        bodies.Payload,
        bodies.BaseTilt,
        bodies.FluidDrag,
        contacts.AnisotropicFriction,
        contacts.Stiction,
        contacts.Adhesion,
    )
}
SIMULATED: dict[str, type[Law]] = {**PHYSICS, custom.NAME: custom.Custom}  # and the one that is data
MEASUREMENT: dict[str, type[Fault]] = {
    fault.name: fault
    for fault in (
        measurement.SensorDelay,
        measurement.ClockSkew,
        measurement.SensorBias,
        measurement.MarkerSlip,
        measurement.FrameMisalignment,
        measurement.Outliers,
    )
}
ALL: dict[str, type[Law] | type[Fault]] = {**PHYSICS, **MEASUREMENT}
QUANTITIES: dict[str, tuple[Quantity, ...]] = {name: law.quantities for name, law in ALL.items()}
CATEGORIES: dict[str, str] = {name: law.category for name, law in ALL.items()}


def between_steps(effects: Sequence[Effect]) -> int:
    """What there is to be done between two time steps: 0 nothing, 1 setpoints, 2 what laws do that read the state."""
    laws = [SIMULATED[effect.name] for effect in effects]
    return max((2 if law.stepped else int(issubclass(law, setpoints.SetpointLaw)) for law in laws), default=0)
