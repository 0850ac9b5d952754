"""A crane whose loops are found from commands: a rail and a turning joint, three logs."""

from dataclasses import replace

import numpy as np

from helpers.mujoco_plant import multisine
from robotid.data.log import Log
from robotid.dynamics.simulation.loops import ClosedLoopRobot, cut_windows
from robotid.estimation.fitting.estimator_settings import SimulationSettings
from robotid.identification.closed_loop.from_commands import identify_loops
from robotid.identification.closed_loop.loop_settings import LoopSettings
from robotid.identification.closed_loop.stages import stated_loops
from robotid.robot.drives import Viscous
from robotid.robot.model import RobotModel

INERTIAL = """<inertial><mass value="2"/><origin xyz="0.1 0 0"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>"""
CRANE = f"""<robot name="crane"><link name="base"/><link name="cart">{INERTIAL}</link>
<link name="boom">{INERTIAL}</link>
<joint name="rail" type="prismatic"><parent link="base"/><child link="cart"/><axis xyz="1 0 0"/>
<limit lower="-9" upper="9" effort="90" velocity="9"/></joint>
<joint name="turn" type="revolute"><parent link="cart"/><child link="boom"/><axis xyz="0 0 1"/>
<limit lower="-9" upper="9" effort="90" velocity="9"/></joint></robot>"""
LOOP = LoopSettings(kp={"rail": 300.0, "turn": 40.0}, kd={"rail": 30.0, "turn": 3.0},
                    limit={"rail": 80.0})  # fmt: skip
STARTS, RATES = (0.0, 5.0, -2.0), (250.0, 200.0, 125.0)  # of two logs and one kept apart


def identified_crane(folder):
    """Return what is found of the crane from two logs, a third kept apart; its delay is free."""
    path, rng = folder / "crane.urdf", np.random.default_rng(0)
    path.write_text(CRANE)
    model = RobotModel.from_urdf(path, terms=("armature", "viscous"))
    loops = replace(
        stated_loops(model, LOOP), armature=np.array([0.5, 0.05]), delay=np.full(2, 0.006),
        terms=((Viscous(),),) * 2, values=np.array([5.0, 0.5]),
    )  # fmt: skip
    logs = []
    for start, rate in zip(STARTS, RATES, strict=True):
        t = start + np.arange(round(1.5 * rate)) / rate
        q_ref = multisine(t - start, np.zeros(2), np.array([0.2, 0.5]), rng)
        told = Log(t, q_ref, 0 * q_ref, model.joints, q_ref=q_ref, has_torque=False)
        [out] = ClosedLoopRobot(model, step=1e-3).roll_out(loops, cut_windows(told, np.inf, 0.0))
        logs.append(replace(told, q=out.q + 3e-4 * rng.standard_normal(out.q.shape)))
    settings = SimulationSettings(window=0.75, lead=0.2, bodies=0.0, step=4e-3)
    return identify_loops(model, logs[:2], logs[2:], LOOP, settings, chooses=False)
