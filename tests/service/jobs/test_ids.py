# SPDX-License-Identifier: Apache-2.0
"""Ids and cursors of another form never reach the database."""

from typing import Any

import pytest


@pytest.mark.parametrize("text", ["%00", "a%00b", "x", "F" * 32, "0" * 31, "%F0%9F%A6%80"])
def test_an_id_of_another_form(play: Any, text: str) -> None:
    """It is 404 on every route and in both databases, which differ in NUL."""

    async def scenario(house: Any) -> None:
        for method, path in (
            ("GET", f"/jobs/{text}"),
            ("GET", f"/jobs/{text}/events"),
            ("GET", f"/jobs/{text}/result"),
            ("DELETE", f"/jobs/{text}"),
            ("GET", f"/jobs?cursor={text}"),
        ):
            answer = await house.http.request(method, path)
            assert (answer.status_code, answer.json()["code"]) == (404, "unknown_job"), path

    async def silent(*_: object) -> None:
        raise AssertionError("the database was asked")

    async def whole(house: Any) -> None:
        house.jobs._database.read = house.jobs._database.write = silent
        await scenario(house)

    play(whole)
