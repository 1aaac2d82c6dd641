"""An arm that a person moves by hand while a cell is set up: it is read and shown, and only stopped."""

from __future__ import annotations

import contextlib

from calibrate.arms.kinematics import MODELS
from station.cell.config import RobotConfig
from station.cell.errors import RobotError
from station.devices.ur.dashboard import STOP, STOPPED
from station.devices.ur.link import UrLink
from station.devices.ur.probe import identify, open_dashboard, unsupported_model


class GuidedArm(UrLink):
    """The read-only half of the driver, and STOP."""

    @classmethod
    async def connected_to(cls, host: str) -> GuidedArm:
        """Connect for reading only. Raises RobotError that names the pendant's menu items.

        `host` may be followed by the model, for a controller that does not tell it.
        """
        address, _, told = host.partition(" ")
        dashboard = await open_dashboard(address)
        found = await identify(dashboard)
        await dashboard.close()
        model = told or found.model
        if found.model and found.model not in MODELS:
            raise unsupported_model(found.model, address)
        if model not in MODELS:
            raise RobotError("model-not-told", host=address, known=", ".join(MODELS))
        arm = cls(RobotConfig(model=model, host=address))
        await arm.connect()
        return arm

    def trouble(self) -> str:
        """Why the arm cannot be guided now, and what to do on the pendant; empty: nothing."""
        try:
            return self.condition(self.state()).held
        except RobotError as problem:
            return str(problem)

    async def stop(self) -> None:
        """STOP, by the dashboard: it ends whatever program runs on the controller. RobotError if refused."""
        said = ""
        if self.dashboard is not None:
            with contextlib.suppress(RobotError):
                said = await self.dashboard.ask(STOP)
        if said != STOPPED:  # dead, or opened in local control: refused even after the switch to remote
            said = await (await self.renew_dashboard()).ask(STOP)
        if said != STOPPED:
            raise RobotError("stop-refused", answer=said)
