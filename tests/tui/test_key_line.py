"""The keys at the bottom can be read in full at 80 columns."""

from __future__ import annotations

import pytest
from textual.widgets import Footer
from textual.widgets._footer import FooterKey, FooterLabel

from tests.tui.conftest import FakeLink, opened, until


@pytest.mark.parametrize("screen", "123456")
async def test_every_key_is_inside_80_columns(link: FakeLink, screen: str) -> None:
    async with opened(link) as pilot:
        await pilot.press(screen)
        footer = pilot.app.screen.query_one(Footer)
        await until(pilot, lambda: len(footer.query(FooterKey)) >= 14)
        await pilot.pause()
        for part in [*footer.query(FooterKey), *footer.query(FooterLabel)]:
            assert part.region.right <= 80, part
            assert part.region.bottom <= 24, part
            assert part.region.size == part.size
        assert footer.size.height <= 2
