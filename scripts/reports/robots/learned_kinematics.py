"""Cases of the report on arms with unknown kinematics, by the LIP protocol."""

from scripts.reports.case import Findings, by_case
from scripts.reports.robots.lip import kernel_rows, rows
from scripts.reports.rows import Row

SEEDS = range(10)
"""Seeds of the starts."""
SAMPLES = {500: 10, 150: 33, 50: 100}
"""Numbers of training samples, and the strides that give them."""
SMALLER = ("panda-3", "panda-4", "panda-5", "panda-6", "skew-arm", "sliding-arm")


def seven_joints(quick: bool) -> Findings:
    """The Panda from 500 samples, over seeds of the starts, with friction and without."""
    if quick:
        return found(rows("panda-3", friction=False, seeds=(0,), tests=(101, 102)))
    return found([row for friction in (False, True) for row in rows("panda-7", friction=friction, seeds=SEEDS)])


def fewer_joints(quick: bool) -> Findings:
    """Three to six joints, and two arms that are not all perpendicular, one of them with a prismatic joint."""
    if quick:
        return found(rows("sliding-arm", friction=False, seeds=(0,), tests=(101, 102)))
    return found(
        [
            row
            for name in SMALLER
            for friction in (False, True)
            for row in rows(name, friction=friction, seeds=SEEDS[:3])
        ]
    )


def fewer_samples(quick: bool) -> Findings:
    """The Panda from 150 and from 50 samples."""
    if quick:
        return found(rows("panda-3", friction=False, every=SAMPLES[150], seeds=(0,), tests=(101, 102)))
    return found(
        [
            row
            for samples in (150, 50)
            for friction in (False, True)
            for row in rows("panda-7", friction=friction, every=SAMPLES[samples], seeds=SEEDS[:3])
        ]
    )


def kernels(quick: bool) -> Findings:
    """Energies in kernel form for the Panda's first three to seven joints, and for all joints from fewer samples."""
    if quick:
        return found(kernel_rows("panda-3", friction=False, every=SAMPLES[50], tests=(101,)))
    arms = [(f"panda-{d}", SAMPLES[500]) for d in range(3, 8)] + [("panda-7", SAMPLES[150]), ("panda-7", SAMPLES[50])]
    by_case = [kernel_rows(name, friction=friction, every=every) for name, every in arms for friction in (False, True)]
    any_order = [kernel_rows("panda-7", friction=friction, serial=False) for friction in (False, True)]
    return found([row for rows in (*by_case, *any_order) for row in rows])


def unknown_trees(quick: bool) -> Findings:
    """Branched arms, joints in a wrong order and flexible joints, whose tree a chain does not hold."""
    return found([row for plant in PLANTS for row in plant_rows(plant, range(1 if quick else 3))])


def found(listed: list[Row]) -> Findings:
    """Findings with the rows, and median and worst errors by case to draw."""
    curves = {}
    for case, numbers in by_case(listed).items():
        median = numbers["nmse_mean_median"]
        curves[case.removeprefix("lip/")] = [median, numbers.get("nmse_mean_worst", median)]
    return Findings(listed, curves)
