"""The rival by evosax improves a policy, and refuses devices that do not divide its creatures."""

import jax
import numpy as np
import pytest
from jax.sharding import Mesh
from small_creature import EPISODE, block_task

from dln_jax.locomotion.learning import Goal, compile_learner, learn, make_policy
from dln_jax.scale.mesh import AXIS
from dln_jax.types import InputError
from scripts.reports.locomotion.evolution import EvolutionSettings, check, make_evolution_learner

pytest.importorskip("evosax", reason="evolution needs the extra [rivals]")


@pytest.mark.slow
def test_evolution_improves():
    task = block_task()
    settings = EvolutionSettings(lanes=8, deviation=0.3, learning_rate=0.1)
    compiled = compile_learner(task, make_evolution_learner(task, make_policy(task, width=3), settings))
    learned = learn(compiled, seed=0, goal=Goal(30 * compiled.learner.steps))
    assert compiled.learner.steps == 8 * EPISODE
    assert learned.distance > max(0.005, 4 * learned.records[0].distance)
    assert learned.records[-1].skipped == 0


def test_devices_that_do_not_divide_the_creatures_are_refused():
    with pytest.raises(InputError, match="cannot be split over 7 devices"):
        check(None, Mesh(np.array(7 * jax.devices()[:1]), (AXIS,)))
