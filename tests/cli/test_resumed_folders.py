"""A resumed run recognises a folder of data, such as a ROS bag, by its content."""

from dataclasses import dataclass
from pathlib import Path

import pytest

from dln_jax.cli.stored_arguments import with_stored_arguments, write_config
from dln_jax.types import InputError


@dataclass(frozen=True, kw_only=True)
class Arguments:
    out: Path | None = None
    data: Path | None = None
    resume: bool = False


def test_a_moved_folder_is_found_and_a_changed_one_refused(tmp_path):
    bag = tmp_path / "bag"
    (bag / "inner").mkdir(parents=True)
    (bag / "metadata.yaml").write_text("topics")
    (bag / "inner" / "log.mcap").write_bytes(b"states")
    run = tmp_path / "run"
    run.mkdir()
    write_config(run, Arguments(out=run, data=bag))
    resumed = Arguments(out=run, resume=True)
    assert with_stored_arguments(resumed, Arguments).data == bag
    moved = bag.rename(tmp_path / "moved")
    with pytest.raises(InputError, match="which is not here; give its new path by --data"):
        with_stored_arguments(resumed, Arguments)
    again = Arguments(out=run, data=moved, resume=True)
    assert with_stored_arguments(again, Arguments).data == moved
    (moved / "inner" / "log.mcap").write_bytes(b"stated")
    with pytest.raises(InputError, match=r"started with other data than .*moved has now"):
        with_stored_arguments(again, Arguments)
