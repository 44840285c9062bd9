"""Who takes part: options, and Slurm's variables, whole and in parts."""

import pytest

from dln_jax.scale.places import FIRST_PORT, PORTS, Place, address, first_host, local_devices, place_of
from dln_jax.types import InputError

TASK = {
    "SLURM_JOB_ID": "1000",
    "SLURM_STEP_ID": "0",
    "SLURM_STEP_NUM_TASKS": "4",
    "SLURM_STEP_NODELIST": "node[007-008]",
    "SLURM_STEP_TASKS_PER_NODE": "2(x2)",
    "SLURM_NODEID": "1",
    "SLURM_PROCID": "3",
    "SLURM_LOCALID": "1",
}
"""The last of four tasks on two hosts."""


def test_options_are_a_place_and_go_before_slurm():
    assert place_of(2, "node1:5000", 1, TASK) == Place(2, "node1:5000", 1)
    assert place_of(None, None, None, {}) is None
    assert place_of(1, None, None, TASK) is None
    assert place_of(None, None, None, TASK | {"SLURM_STEP_NUM_TASKS": "1"}) is None


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ((2, None, None), "--coordinator and --process-id missing beside --processes"),
        ((None, "node1:5000", None), "--processes and --process-id missing beside --coordinator"),
        ((2, "node1:5000", None), "--process-id missing beside --processes and --coordinator"),
        ((None, None, 0), "missing beside --process-id"),
        ((1, "node1:5000", 0), "leave them out"),
        ((0, None, None), "expected a positive whole number"),
        ((2, "node1:5000", 2), "expected 0 to 1"),
        ((2, "node1:5000", -1), "expected 0 to 1"),
        ((2, "node1", 0), "expected host:port"),
        ((2, "node1:70000", 0), "expected host:port"),
        ((2, "node1:0", 0), "expected host:port"),
        ((2, "http://node1:5000", 0), "expected host:port"),
        ((2, "::1:5000", 0), "expected host:port"),
    ],
)
def test_half_a_place_is_refused(options, said):
    with pytest.raises(InputError, match=said):
        place_of(*options, {})


def test_an_address_may_be_of_ipv6():
    assert address("[fe80::1]:5000") == ("fe80::1", 5000)
    assert address("node1.cluster:5000") == ("node1.cluster", 5000)


def test_a_task_of_slurm_has_its_place():
    place = place_of(None, None, None, TASK)
    assert place is not None
    assert place._replace(coordinator="") == Place(4, "", 3, None, "Slurm")
    host, port = address(place.coordinator)
    assert host == "node007" and FIRST_PORT <= port < FIRST_PORT + PORTS <= 2**16


def test_another_attempt_and_another_step_have_other_ports():
    others = [{}, {"SLURM_RESTART_COUNT": "1"}, {"SLURM_RESTART_COUNT": "2"}, {"SLURM_STEP_ID": "1"}]
    places = [place_of(None, None, None, TASK | other) for other in others]
    assert len({place.coordinator for place in places if place}) == len(others)


@pytest.mark.parametrize("absent", ["SLURM_JOB_ID", "SLURM_STEP_ID", "SLURM_STEP_NODELIST", "SLURM_PROCID"])
def test_half_of_slurm_is_refused(absent):
    half = {name: value for name, value in TASK.items() if name != absent}
    with pytest.raises(InputError, match=f"4 tasks here, but does not set {absent}, .*--processes"):
        place_of(None, None, None, half)


def test_a_shell_beside_the_tasks_of_a_job_is_refused():
    """That of `salloc`, or one that was opened by ssh, knows the job and is none of its tasks."""
    with pytest.raises(InputError, match=r"does not set SLURM_STEP_NUM_TASKS, SLURM_STEP_ID.*start with srun"):
        place_of(None, None, None, {"SLURM_JOB_ID": "1000", "SLURM_NTASKS": "4", "SLURM_PROCID": "0"})


def test_what_is_no_number_is_refused():
    with pytest.raises(InputError, match="SLURM_PROCID is 'x', expected a whole number"):
        place_of(None, None, None, TASK | {"SLURM_PROCID": "x"})


@pytest.mark.parametrize(
    ("nodes", "first"),
    [
        ("node001", "node001"),
        ("node001,host2", "node001"),
        ("node[001-0015],host2", "node001"),
        ("node[001,007-015],host2", "node001"),
        ("gpu[3-4]-ib,cpu1", "gpu3-ib"),
    ],
)
def test_the_first_host_of_a_list(nodes, first):
    assert first_host(nodes) == first


def test_a_list_without_a_host_is_refused():
    with pytest.raises(InputError, match="names no host"):
        first_host("[1-2]")


@pytest.mark.parametrize(
    ("more", "devices"),
    [
        ({}, None),  # no accelerators
        ({"CUDA_VISIBLE_DEVICES": "0,1,2,3"}, (2, 3)),  # all of the host's are shown to each of its two tasks
        ({"CUDA_VISIBLE_DEVICES": "0"}, None),  # its own alone
        ({"CUDA_VISIBLE_DEVICES": "0,1", "SLURM_GPUS_PER_TASK": "2"}, None),
        ({"CUDA_VISIBLE_DEVICES": "0,1", "SLURM_STEP_TASKS_PER_NODE": "1(x4)"}, None),
        ({"CUDA_VISIBLE_DEVICES": "0,1,2", "SLURM_STEP_TASKS_PER_NODE": "1,3", "SLURM_LOCALID": "2"}, (2,)),
    ],
)
def test_a_task_has_its_share_of_accelerators(more, devices):
    assert local_devices(TASK | more) == devices
