"""The calibration in use is the one that is published."""

import dataclasses
import threading
from pathlib import Path
from types import SimpleNamespace

from eschorty_ros.srv import LoadCalibration
from reconstructing import CALIBRATION

from eschorty_ros.core.calibration import Targets
from eschorty_ros.core.optics import Calibration, save_named_calibration
from eschorty_ros.nodes.reconstruction.active_calibration import ActiveCalibration

FITTED = dataclasses.replace(CALIBRATION, date="2026-01-01")


def test_of_one_that_is_loaded_and_one_that_is_stored_the_last_in_use_is_published(tmp_path: Path):
    save_named_calibration(tmp_path, CALIBRATION, "before")
    published: list[str] = []
    used: list[str] = []
    services = {}
    node = SimpleNamespace(
        create_publisher=lambda *_: SimpleNamespace(publish=lambda m: published.append(m.date)),
        create_service=lambda _, name, callback, **__: services.update({name: callback}),
        get_clock=lambda: SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=0)),
        get_logger=lambda: SimpleNamespace(info=lambda _: None),
    )

    def load() -> None:
        answer = LoadCalibration.Response()
        services["reconstruction/load_calibration"](
            LoadCalibration.Request(calibration="before"), answer
        )
        assert answer.success

    loading = threading.Thread(target=load)

    def use(calibration: Calibration) -> None:
        used.append(calibration.date or "")
        if calibration is FITTED:
            loading.start()
            # It ends here unless it waits, as it should, for the end of this exchange.
            loading.join(0.5)

    active = ActiveCalibration(node, CALIBRATION, "", str(tmp_path), False, use)
    active.store(FITTED, Targets([100.0], [900.0]))
    loading.join()
    assert used == [FITTED.date, ""]
    assert published[1:] == used
    assert active.calibration == CALIBRATION
