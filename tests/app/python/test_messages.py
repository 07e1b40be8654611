"""Messages name options that Python accepts."""

from __future__ import annotations

import pandas as pd
import pytest

import nnode
from nnode.errors import IN_PYTHON, ConfigError, DataError
from tests.data.check.planted import cars


def test_option_named_in_a_message_is_accepted() -> None:
    table = pd.concat(
        [
            cars(3, 6.0).assign(sequence=k).rename(columns={"veh": "agent", "t": "time"})
            for k in range(3)
        ]
    )[["sequence", "time", "agent", "x"]]
    broken = table.assign(x=table.x.where(table.time != 3.0, table.x + 300))
    for call in (nnode.fit, nnode.sequences, nnode.Calibrator().fit):
        with pytest.raises(DataError, match=r"data\.faults=keep keeps faulty ones") as error:
            call(broken)  # type: ignore[operator]
        assert error.value.__notes__ == [IN_PYTHON]
    assert len(nnode.sequences(broken, faults="keep")) == 3
    assert nnode.fit(broken, "traffic", epochs=1, heldout=0, faults="keep").n_iter == 1
    with pytest.raises(ConfigError, match=r"no option data\.fault; .*did you mean data\.faults\?"):
        nnode.fit(table, "traffic", fault="keep")


def test_ambiguous_tables_give_an_error_with_the_options() -> None:
    table = cars(4, 10.0)
    ambiguous = table.assign(track=table.veh + (table.t > 5))
    with pytest.raises(ConfigError, match=r"agent may be veh or track.*data\.columns\.agent=veh"):
        nnode.fit(ambiguous, "traffic")
    assert len(nnode.sequences(ambiguous, columns={"agent": "track"})) > 0
    frames = table.assign(frame=(10 * table.t).round()).drop(columns=["t", "v"])
    with pytest.raises(ConfigError, match=r"5 or 10 or .* frames/s fit: .*data\.frame_rate=\d+"):
        nnode.fit(frames, "traffic")
    assert nnode.sequences(frames, frame_rate=10)[0].dt == pytest.approx(0.2)
