"""Two real tendon-driven robots as chains of rigid links, for the diagnosis of their recordings.

    python -m soro_bench.models.real_robots

writes ``assets/mjcf/real``: ``opencr_tdcr.xml`` and ``asl_trunk.xml``, and of each one with twice the links, from which
the diagnosis takes its discretisation error. The TOML files beside them are not generated.

Each segment is cut into equal links, and a joint in the middle of each bends about two axes. Tendons run through holes.
The holes of a segment's tendons lie on rings, bodies without joints in the middle of which the axis passes: turning a
ring about z moves its holes round the axis, and scaling the positions of the holes scales their distance from it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np

from soro_bench.files import mjcf_path


@dataclass(frozen=True)
class Tendon:
    """A tendon parallel to the axis.

    segment: at the end of which it is tied, from 0. angle: rad, of its holes about the axis, from x.
    """

    name: str
    segment: int
    angle: float


@dataclass(frozen=True)
class Chain:
    """An elastic rod with tendons.

    lengths: m, of the segments. links: of a segment. radius: m, of the circle of the tendons. mass: kg, of all of it.
    bending: N m^2, Young's modulus times second moment of area. relaxation: s, of the joints, damping over stiffness.
    hole: m, from a joint to the holes behind it; None where only the ends of segments have holes.
    """

    lengths: tuple[float, ...]
    links: int
    radius: float
    mass: float
    bending: float
    relaxation: float
    tendons: tuple[Tendon, ...]
    hole: float | None = None

    def hang(self, base: mujoco.MjsBody) -> tuple[list[mujoco.MjsBody], dict[str, list[str]]]:
        """Add the chain along z of a body.

        Returns:
            The bodies at the ends of the segments, whose frames are half a link before them; and the holes of each
            tendon, from the base on.
        """
        ends: list[mujoco.MjsBody] = []
        holes: dict[str, list[str]] = {tendon.name: [] for tendon in self.tendons}
        body, ahead = base, 0.0
        self._add_rings(base, 0.0, 0, holes)
        for s, length in enumerate(self.lengths):
            link = length / self.links
            for k in range(self.links):
                # the finer model has other links, under other names: no effect at one is at the other
                body = body.add_body(name=f"link{s + 1}_{k + 1}of{self.links}", pos=[0, 0, ahead + link / 2])
                self._add_joints(body, link)
                body.add_geom(
                    type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[0, 0, -link / 4, 0, 0, link / 2],
                    size=[self.radius / 2, 0, 0], contype=0, conaffinity=0, mass=0,
                )  # fmt: skip
                if self.hole is not None:
                    self._add_rings(body, self.hole, s, holes)
                ahead = link / 2
            ends.append(body)
            if self.hole is None:
                self._add_rings(body, ahead, s, holes)
        return ends, holes

    def end(self, segment: int) -> float:
        """m, from the frame of the body that ends a segment to that end."""
        return self.lengths[segment] / self.links / 2

    def _add_joints(self, body: mujoco.MjsBody, link: float) -> None:
        """Two hinges that are as stiff as a link, and its inertia, that of a cylinder through the tendons."""
        stiffness = self.bending / link
        for axis, direction in (("x", [1, 0, 0]), ("y", [0, 1, 0])):
            body.add_joint(
                name=f"bend_{axis}{body.name.removeprefix('link')}",
                type=mujoco.mjtJoint.mjJNT_HINGE,
                axis=direction,
                stiffness=[stiffness, 0, 0],
                damping=[self.relaxation * stiffness, 0, 0],
            )
        mass = self.mass * link / sum(self.lengths)
        across = mass * (3 * self.radius**2 + link**2) / 12
        body.explicitinertial = True
        body.mass, body.ipos, body.inertia = mass, [0, 0, 0], [across, across, mass * self.radius**2 / 2]

    def _add_rings(self, body: mujoco.MjsBody, z: float, first: int, holes: dict[str, list[str]]) -> None:
        """Holes of the tendons that are tied at the end of segment ``first`` or beyond."""
        for s in range(first, len(self.lengths)):
            ring = body.add_body(name=f"ring{s + 1}_{body.name}", pos=[0, 0, z])
            for tendon in self.tendons:
                if tendon.segment == s:
                    name = f"{tendon.name}_{len(holes[tendon.name])}"
                    x, y = self.radius * np.cos(tendon.angle), self.radius * np.sin(tendon.angle)
                    ring.add_site(name=name, pos=[x, y, 0])
                    holes[tendon.name].append(name)


def _spec(name: str, timestep: float, gravity: Sequence[float]) -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    spec.modelname = name
    spec.option.timestep, spec.option.gravity = timestep, gravity
    # the only integrator that is implicit in the stiffness of joints, tendons and actuators
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    return spec


# --- OpenCR-TDCR: steel backbone, three tendons to the end of each of three segments, a servo for each tendon ---------
# [authors]: the configuration of the authors' model, github.com/ContinuumRoboticsLab/opencr-mujoco,
# configs/generation/ftdcr_v4_sysid.json.

_SERVOS = ((4, 3, 9), (5, 2, 8), (6, 1, 7))  # of the tendons of each segment: the columns of the recordings
# rad, of the first tendon of each segment [authors]; the others follow at even distances. The authors add up to 0.14
# rad to those, from a fit to pulls of single tendons; without that the recording of the same robot is fitted better.
_FIRST_ANGLES = (-3.0589, -2.5615, -2.0506)
_PRETENSION = (0.0006, 1.16, 3.87)  # N, of the tendons of each segment [authors]
_SERVO_STIFFNESS = 7000.0  # N/m [authors]
_MOST_TENSION = 100.0  # N [authors]
_BEYOND_TIP = 0.008  # m, where the marker is [authors]
OPENCR = Chain(
    lengths=(0.060, 0.0625, 0.064),  # [authors]
    links=5,
    radius=0.0045,  # [authors]
    # 50 g [authors], made so light that a step of Newton's method takes the robot to rest: see opencr_tdcr()
    mass=0.0005,
    bending=50e9 * np.pi / 4 * 0.0005**4,  # 50 GPa, a wire of 0.5 mm radius [authors]
    relaxation=0.0,
    tendons=tuple(
        Tendon(f"servo_{number}", s, _FIRST_ANGLES[s] + i * 2 * np.pi / 3)
        for s, numbers in enumerate(_SERVOS)
        for i, number in enumerate(numbers)
    ),
    # A joint that bends by b shortens all tendons by hole (1 - hole / link) b^2 / 2, whichever side they are on. Half
    # as many joints do so by as much in all as those of the authors' model, with holes in the middle between them.
    hole=0.0008,
)
_FINE_LINKS, _FINE_HOLE = 10, 0.003  # of a segment; m [authors]


def opencr_tdcr(fine: bool = False) -> mujoco.MjSpec:
    """The robot at rest under its servos, one state after the other.

    No weight acts on it in the authors' model, and the recording fits no better with one. What remains is to find where
    the springs are at rest. A step of the discrete integrator that is long against every period of the robot is one
    step of Newton's method for that.
    """
    chain = replace(OPENCR, links=_FINE_LINKS, hole=_FINE_HOLE) if fine else OPENCR
    spec = _spec("opencr_tdcr", timestep=0.15, gravity=(0, 0, 0))
    base = spec.worldbody.add_body(name="base")
    ends, holes = chain.hang(base)
    ends[-1].add_site(name="tip", pos=[0, 0, chain.end(2) + _BEYOND_TIP])
    for tendon in chain.tendons:
        added = spec.add_tendon(name=tendon.name)
        for hole in holes[tendon.name]:
            added.wrap_site(hole)
        # tension = stiffness (displacement - (length at rest - length)) + pretension, never below zero
        rest = sum(chain.lengths[: tendon.segment + 1]) - chain.end(tendon.segment) + (chain.hole or 0.0)
        spec.add_actuator(
            name=tendon.name, trntype=mujoco.mjtTrn.mjTRN_TENDON, target=tendon.name,
            gear=[-1, 0, 0, 0, 0, 0],  # a positive force pulls
            gaintype=mujoco.mjtGain.mjGAIN_FIXED, gainprm=[_SERVO_STIFFNESS] + [0] * 9,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            biasprm=[_PRETENSION[tendon.segment] - _SERVO_STIFFNESS * rest, -_SERVO_STIFFNESS] + [0] * 8,
            forcelimited=True, forcerange=[0, _MOST_TENSION],
            ctrllimited=True, ctrlrange=[-0.010, 0.010],  # m, in the recordings
        )  # fmt: skip
    return spec


# --- ASL trunk: a hose with three disks, four tendons to each, six motors that drive two opposite tendons each --------
# [lab]: github.com/StanfordASL/trunk-stack, docs/mechanical_design.md and the MuJoCo model there. [recordings]: what
# servo_random1_0g.npz says. Stiffness, damping and mass are not documented: the numbers below are what brings the model
# near that recording, and parameters of the mapping with wide priors.

# disk from 0, and the direction in which a positive command bends the trunk: the tips move to -48, -107, -176, 163, 111
# and 43 degrees [recordings], and a disk has twelve channels in equal distances [lab]
_MOTORS = ((1, -45), (2, -105), (0, -165), (2, 165), (0, 105), (1, 45))
_DRUMS = (0.012, 0.024, 0.036)  # m, radii for the tendons to each disk: bends of 0.4, 0.8 and 1.3 rad/rad [recordings]
# N/m at the drum, of motor, mechanism and tendons together: all of it gives way there, so that friction of the drum
# is friction of the tendons
_DRUM_STIFFNESS = 2e4
_DRUM_RELAXATION = 0.005  # s
_TENDON_STIFFNESS = 1e5  # N/m, each: next to nothing
_DRUM_MASS = 0.1  # kg, of a drum and its motor, as felt by the tendons
_TIP_MASS = 0.05  # kg, of the gripper: assumed, as is its inertia below
ASL = Chain(
    lengths=(0.1055, 0.095, 0.116),  # between disks where the trunk is straight [recordings]; 0.32 m in all [lab]
    links=3,
    radius=0.025,  # [lab]
    mass=0.05,
    bending=0.3,
    relaxation=0.15,
    tendons=tuple(
        Tendon(f"tendon{i + 1}{sign}", disk, np.radians(direction + turn))
        for i, (disk, direction) in enumerate(_MOTORS)
        for sign, turn in (("a", 0), ("b", 180))
    ),
)
_REACH = 0.1  # m, between a drum and the pulleys before and behind it: more than it ever moves


def asl_trunk(fine: bool = False) -> mujoco.MjSpec:
    """The trunk under its motors, hanging along -y from the origin of motion capture.

    A drum is a slide: its position is the tendon that it has wound up. It pulls tendon a, which comes straight to it,
    and lets go of tendon b, which comes to it over a pulley behind it.
    """
    chain = replace(ASL, links=2 * ASL.links) if fine else ASL
    spec = _spec("asl_trunk", timestep=0.01, gravity=(0, -9.81, 0))
    # z of the trunk is -y of motion capture, and its y is their z; its axis is where it is at rest [recordings]
    mount = spec.worldbody.add_body(name="mount", pos=[0.1, 0, 0.105], quat=[np.sqrt(0.5), np.sqrt(0.5), 0, 0])
    base = mount.add_body(name="base")
    ends, holes = chain.hang(base)
    for s, body in enumerate(ends):
        body.add_site(name=f"disk{s + 1}", pos=[0, 0, chain.end(s)])
    tip = ends[-1].add_body(name="gripper", pos=[0, 0, chain.end(2)])
    tip.explicitinertial, tip.mass, tip.ipos = True, _TIP_MASS, [0, 0, 0]
    tip.inertia = [4e-5] * 3  # assumed: a ball of 50 g with a radius of 4.5 cm
    for i in range(len(_MOTORS)):
        _add_motor(spec, base, i, chain, holes)
    return spec


def _add_motor(spec: mujoco.MjSpec, base: mujoco.MjsBody, i: int, chain: Chain, holes: dict[str, list[str]]) -> None:
    """Motor i: a drum, the two tendons that it winds up and lets go of, and the actuator that turns it."""
    drum_radius = _DRUMS[_MOTORS[i][0]]
    drum = base.add_body(name=f"drum{i + 1}", pos=[0, 0, -_REACH])
    drum.explicitinertial, drum.mass, drum.ipos, drum.inertia = True, _DRUM_MASS, [0, 0, 0], [1e-4] * 3
    drum.add_joint(name=f"drum{i + 1}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, -1])
    for tendon in chain.tendons[2 * i : 2 * i + 2]:
        x, y = chain.radius * np.cos(tendon.angle), chain.radius * np.sin(tendon.angle)
        end = drum.add_site(name=f"{tendon.name}_drum", pos=[x, y, 0])
        path, rest = [end.name], _REACH + sum(chain.lengths[: tendon.segment + 1])
        if tendon.name.endswith("b"):
            path.append(base.add_site(name=f"{tendon.name}_pulley", pos=[x, y, -2 * _REACH]).name)
            rest += 2 * _REACH
        # at rest it is just taut: a mechanism with soft springs takes up what its drum lets go of [lab]
        added = spec.add_tendon(name=tendon.name, stiffness=[_TENDON_STIFFNESS, 0, 0], springlength=[0, rest])
        for site in [*path, *holes[tendon.name]]:
            added.wrap_site(site)
    spec.add_actuator(
        name=f"motor{i + 1}", trntype=mujoco.mjtTrn.mjTRN_JOINT, target=f"drum{i + 1}",
        gaintype=mujoco.mjtGain.mjGAIN_FIXED, gainprm=[_DRUM_STIFFNESS * drum_radius] + [0] * 9,  # of a command in rad
        biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        biasprm=[0, -_DRUM_STIFFNESS, -_DRUM_STIFFNESS * _DRUM_RELAXATION] + [0] * 7,
    )  # fmt: skip


ROBOTS = {"opencr_tdcr": opencr_tdcr, "asl_trunk": asl_trunk}


def main() -> None:
    """Write the models."""
    folder = mjcf_path("trunk.xml").parent / "real"
    folder.mkdir(exist_ok=True)
    note = "<!-- Written by soro_bench/models/real_robots.py, which has the sources of all numbers. -->\n"
    for name, build in ROBOTS.items():
        for fine, path in ((False, f"{name}.xml"), (True, f"{name}_fine.xml")):
            spec = build(fine)
            spec.compile()
            Path(folder, path).write_text(note + spec.to_xml())


if __name__ == "__main__":
    main()
