"""Draw frames, angles and signs of both robots: ``python docs/frames.py`` writes static/frames.svg.

Every point comes from ``coop_env``: dimensions, kinematics, holes.
"""

from pathlib import Path
from typing import Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Circle

from coop_env.geometry import DELTA, OPTIMIZED
from coop_env.kinematics import delta, rrs
from coop_env.simulation.insertion_task import InsertionTask

TARGET: Final = Path(__file__).parent / "static" / "frames.svg"
BLUE, RED, GREY = "#1f6fb4", "#c0392b", "#666666"
PITCH: Final = 0.30  # rad, of the pose drawn
LIFT: Final = np.array([0.0, 0.0, DELTA.base_height])


def arrow(axes: Axes, start: np.ndarray, end: np.ndarray, text: str, color: str = "black") -> None:
    """An arrow with its name at the tip; points (2,), m."""
    axes.annotate(
        "", tuple(end), tuple(start), arrowprops={"arrowstyle": "-|>", "color": color, "lw": 1.6}
    )
    way = (end - start) / np.linalg.norm(end - start)
    axes.text(
        end[0] + 0.016 * way[0],
        end[1] + 0.016 * way[1],
        text,
        color=color,
        ha="center",
        va="center",
    )


def angle(axes: Axes, centre: np.ndarray, end: np.ndarray, text: str, color: str) -> None:
    """The angle at ``centre`` from the outward horizontal to ``end``; points (2,), m."""
    radius, way = 0.075, end - centre
    axes.plot([centre[0], centre[0] + 0.1], [centre[1]] * 2, ":", color=color, lw=1)
    found = np.degrees(np.arctan2(way[1], way[0]))
    axes.add_patch(Arc((centre[0], centre[1]), 2 * radius, 2 * radius, theta1=min(0, found),
                       theta2=max(0, found), color=color))  # fmt: skip
    axes.text(centre[0] + 0.105, centre[1] + 0.012 * np.sign(found), text, color=color,
              va="bottom" if found > 0 else "top")  # fmt: skip


def limbs(axes: Axes, points: np.ndarray, plane: list[int], color: str) -> None:
    """Three limbs (3 limbs, 3 joints, 3); the first stands out."""
    for number, limb in reversed(list(enumerate(points))):
        axes.plot(*limb[:, plane].T, "-o", color=color, lw=2.4 if number == 0 else 1.0, ms=4,
                  alpha=1.0 if number == 0 else 0.35)  # fmt: skip


def side(axes: Axes, position: np.ndarray, pose: np.ndarray) -> None:
    """Both robots in the plane y = 0, seen against the y axis."""
    plane, task = [0, 2], InsertionTask()
    upper, lower = delta.limb_points(position) + LIFT, rrs.limb_points(pose, OPTIMIZED)
    centre, rotation = rrs.platform_pose(pose, OPTIMIZED)[:2]
    limbs(axes, upper, plane, BLUE)
    limbs(axes, lower, plane, RED)
    for points, joint in ((upper, 0), (upper, 2), (lower, 2)):
        axes.plot(*points[[0, 1], joint][:, plane].T, color=GREY, lw=3, alpha=0.5)
    effector = position + LIFT
    tip = effector - [0, 0, DELTA.peg_length]
    axes.plot(*np.array([effector, tip])[:, plane].T, color="black", lw=3)
    axes.annotate("tip", tip[plane], tip[plane] + [-0.07, 0.03], arrowprops={"arrowstyle": "-"})
    axes.add_patch(Circle((centre[0], centre[2]), task.dome_radius, fill=False, color=RED, lw=1.2))
    for number, normal in enumerate(task.hole_normals):
        out = rotation @ np.array(normal)
        mouth = centre + task.dome_radius * out
        if abs(normal[1]) < 1e-9:
            axes.plot(*mouth[plane], "s", color=RED, ms=5)
            arrow(axes, mouth[plane], (mouth + 0.05 * out)[plane], f"n{number}", RED)
    arrow(axes, centre[plane], (centre + 0.17 * rotation[:, 2])[plane], "n", RED)
    axes.plot([centre[0]] * 2, [centre[2], centre[2] + 0.19], ":", color=GREY)
    axes.text(centre[0] - 0.01, centre[2] + 0.17, "pitch > 0", color=RED, ha="right")
    axes.annotate("", (-0.3, centre[2]), (-0.3, 0), arrowprops={"arrowstyle": "<->"})
    axes.text(-0.31, centre[2] / 2, "heave", rotation=90, ha="right", va="center")
    axes.annotate("", (-0.38, DELTA.base_height), (-0.38, 0), arrowprops={"arrowstyle": "<->"})
    axes.text(-0.39, DELTA.base_height / 2, "base_height", rotation=90, ha="right", va="center")
    angle(axes, upper[0, 0][plane], upper[0, 1][plane], "theta > 0", BLUE)
    angle(axes, lower[0, 0][plane], lower[0, 1][plane], "q > 0", RED)
    for height, name in (
        (0.0, "world frame = base of the 3-RRS"),
        (DELTA.base_height, "base of the Delta"),
    ):
        origin = np.array([0.0, height])
        arrow(axes, origin, origin + np.array([0.1, 0.0]), "x")
        arrow(axes, origin, origin + np.array([0.0, 0.1]), "z")
        axes.text(0.0, height - 0.02, name, ha="center", va="top")
    axes.annotate("", effector[plane], (0, DELTA.base_height),
                  arrowprops={"arrowstyle": "-|>", "color": BLUE, "ls": "--"})  # fmt: skip
    axes.text(0.0, DELTA.base_height - 0.2, "(x, y, z), z < 0", color=BLUE)
    axes.set_title("Side view at a pitch, y away from the reader")


def top(axes: Axes) -> None:
    """Both bases, the platform and the holes at home, seen from above."""
    task, plane = InsertionTask(), [0, 1]
    upper = delta.limb_points([0.0, 0.0, -0.45])
    lower = rrs.limb_points([0.0, 0.0, OPTIMIZED.home_heave], OPTIMIZED)
    limbs(axes, upper, plane, BLUE)
    limbs(axes, lower, plane, RED)
    axes.add_patch(Circle((0, 0), task.dome_radius, fill=False, color=RED, lw=1.2))
    for number, normal in enumerate(task.hole_normals):
        mouth = task.dome_radius * np.array(normal)
        axes.plot(*mouth[plane], "s", color=RED, ms=5)
        axes.text(mouth[0] + 0.008, mouth[1] + 0.008, str(number), color=RED)
    for limb, name in enumerate(("limb 0,\nazimuth 0°", "limb 1,\n120°", "limb 2,\n240°")):
        x, y = 1.15 * upper[limb, 1, :2]
        axes.text(x, y, name, ha="center", va="center", color=GREY)
    arrow(axes, np.zeros(2), np.array([0.2, 0.0]), "x")
    arrow(axes, np.zeros(2), np.array([0.0, 0.2]), "y")
    axes.text(0.0, -0.4, "roll > 0 turns y towards z: n leans to -y\n"
              "pitch > 0 turns z towards x: n leans to +x", ha="center", color=RED)  # fmt: skip
    axes.set_title("Top view at home: limbs and holes 0 to 5")


def main() -> None:
    """Write the picture."""
    mpl.rcParams.update({"svg.hashsalt": "frames", "font.size": 9})
    figure = Figure(figsize=(11, 7), layout="constrained")
    left, right = figure.subplots(1, 2)
    side(left, np.array([-0.06, 0.0, -0.36]), np.array([0.0, PITCH, OPTIMIZED.home_heave]))
    top(right)
    handles = [
        *left.plot([], [], color=BLUE, label="Delta"),
        *left.plot([], [], color=RED, label="3-RRS"),
    ]
    left.set(xlim=(-0.45, 0.42), ylim=(-0.08, 0.99))
    right.set(xlim=(-0.32, 0.42), ylim=(-0.45, 0.42))
    left.legend(handles=handles, loc="center right", frameon=False)
    for axes in (left, right):
        axes.set_aspect("equal")
        axes.set_axis_off()
    figure.savefig(TARGET, metadata={"Date": None})
    print(f"Written to {TARGET}")


if __name__ == "__main__":
    main()
