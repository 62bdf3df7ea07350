# SPDX-License-Identifier: Apache-2.0
"""Webhooks: signed, repeated until they arrive, and sent to public addresses only."""

import asyncio
import base64
import hashlib
import hmac
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any
from urllib.parse import quote, urlsplit

import pytest

from pugeo_service.jobs.webhook_address import ForbiddenAddressError, check_url, resolve
from pugeo_service.problems import ProblemError
from pugeo_service.settings import Settings

KEY = bytes(range(32))
SECRET = f"whsec_{base64.b64encode(KEY).decode()}"


class Receiver:
    """A server that records requests and answers with the next of some statuses.

    Attributes:
        requests: headers by lower-case name, and body, of each request.
        statuses: of the next answers; 200 after the last one.
    """

    def __init__(self, *statuses: int) -> None:
        self.requests: list[tuple[dict[str, str], bytes]] = []
        self.statuses = list(statuses)
        self.url = ""

    @asynccontextmanager
    async def listening(self) -> AsyncIterator[None]:
        """Listen on a free port of this machine."""
        server = await asyncio.start_server(self._answer, "127.0.0.1", 0)
        self.url = f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}/done?x=1"
        async with server:
            yield

    async def _answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = (await reader.readuntil(b"\r\n\r\n")).decode().splitlines()
        assert head[0] == "POST /done?x=1 HTTP/1.1"
        headers = {
            name.lower(): value for name, _, value in (line.partition(": ") for line in head[1:])
        }
        body = await reader.readexactly(int(headers["content-length"]))
        self.requests.append((headers, body))
        status = self.statuses.pop(0) if self.statuses else 200
        writer.write(b"HTTP/1.1 %d X\r\nContent-Length: 0\r\nConnection: close\r\n\r\n" % status)
        await writer.drain()
        writer.close()


def query(url: str) -> str:
    """The query of a job with a webhook."""
    return f"?R=2&webhook={quote(url, safe='')}"


def signature(headers: dict[str, str], body: bytes) -> str:
    """The signature that the specification asks for."""
    signed = f"{headers['webhook-id']}.{headers['webhook-timestamp']}.".encode() + body
    return "v1," + base64.b64encode(hmac.new(KEY, signed, hashlib.sha256).digest()).decode()


def test_the_end_of_a_job_is_told(play: Any) -> None:
    """A succeeded and a failed job are told once, with a signature and the job."""
    receiver = Receiver()

    async def scenario(house: Any) -> None:
        async with receiver.listening():
            for number, (body, state) in enumerate([(b"cloud", "succeeded"), (b"bug", "failed")]):
                job = await house.submit(body, query(receiver.url))
                assert "webhook" not in job["options"]
                done = await house.until(job["id"], state)
                await house.eventually(lambda known=number: len(receiver.requests) == known + 1)
                headers, content = receiver.requests[number]
                message = json.loads(content)
                assert message["type"] == f"job.{state}"
                assert message["data"] == done
                assert headers["webhook-id"] == f"msg_{job['id']}"
                assert headers["webhook-signature"] == signature(headers, content)
                assert headers["host"] == urlsplit(receiver.url).netloc
            plain = await house.submit()
            await house.until(plain["id"], "succeeded")
            text = (await house.http.get("/metrics")).text
            assert 'pugeo_webhooks_total{outcome="delivered"} 2.0' in text
            assert len(receiver.requests) == 2

    play(scenario, webhook_secret=SECRET, webhook_private=True)


def test_a_webhook_is_repeated(play: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Refused and redirected webhooks are sent again with the same id, and at last given up."""
    monkeypatch.setattr("pugeo_service.jobs.webhooks._WAITS_S", (0.01, 0.01))
    receiver = Receiver(500, 302, 200, 404, 404, 404)

    async def scenario(house: Any) -> None:
        def count(outcome: str) -> float:
            webhooks = house.jobs._telemetry.webhooks
            return float(webhooks.labels(outcome)._value.get())

        async with receiver.listening():
            for attempts in (3, 6):
                job = await house.submit(query=query(receiver.url))
                await house.eventually(lambda known=attempts: len(receiver.requests) == known)
                ids = {headers["webhook-id"] for headers, _ in receiver.requests[attempts - 3 :]}
                assert ids == {f"msg_{job['id']}"}

            await house.eventually(lambda: count("given_up") == 1)
            assert (await house.get(job["id"]))["state"] == "succeeded"

    play(scenario, webhook_secret=SECRET, webhook_private=True)


def test_a_webhook_survives_a_restart(open_house: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """A webhook that one process could not send is sent by the next one."""
    monkeypatch.setattr("pugeo_service.jobs.webhooks._WAITS_S", (0.01,) * 1000)
    receiver = Receiver()
    given = {"webhook_secret": SECRET, "webhook_private": True}

    async def scenario() -> None:
        async with receiver.listening():
            address = receiver.url
        async with open_house(**given) as house:
            job = await house.submit(query=query(address))
            await house.until(job["id"], "succeeded")
        port = urlsplit(address).port
        server = await asyncio.start_server(receiver._answer, "127.0.0.1", port)
        async with server, open_house(**given) as house:
            await house.eventually(lambda: len(receiver.requests) == 1)
        assert receiver.requests[0][0]["webhook-id"] == f"msg_{job['id']}"

    asyncio.run(scenario())


def test_addresses_that_are_not_public(play: Any) -> None:
    """A literal address is refused at once; without a secret each webhook is."""

    async def scenario(house: Any) -> None:
        answer = await house.http.post(f"/jobs{query('http://127.0.0.1/')}", content=b"cloud")
        assert (answer.status_code, answer.json()["code"]) == (422, "bad_option")
        assert "127.0.0.1, which is not a public address" in answer.json()["detail"]

    async def off(house: Any) -> None:
        answer = await house.http.post(f"/jobs{query('https://example.org/')}", content=b"cloud")
        assert answer.status_code == 422
        assert answer.json()["setting"] == "PUGEO_WEBHOOK_SECRET"

    play(scenario, webhook_secret=SECRET)
    play(off)


@pytest.mark.parametrize(
    "address",
    [
        "10.0.0.1", "169.254.169.254", "0.0.0.1", "100.64.0.1", "224.0.0.1", "[::1]", "[fe80::1]",
        "[::ffff:192.168.0.1]", "[64:ff9b::a00:1]", "[2002:a00:1::]",
    ],
)  # fmt: skip
def test_forbidden_addresses(address: str) -> None:
    """Private, local, shared and multicast addresses, also inside others, are refused."""
    with pytest.raises(ProblemError, match="not a public address"):
        check_url(f"https://{address}/", private=False)
    check_url(f"https://{address}/", private=True)


@pytest.mark.parametrize(
    ("url", "reason"),
    [
        ("ftp://example.org/", "must be http"), ("example.org", "must be http"),
        ("http:///path", "must be http"), ("http://[::1", "not a URL"),
        ("http://example.org:99999/", "not a URL"), ("https://a:b@example.org", "name or password"),
        ("https://example.org/a b", "printable ASCII"),
        ("https://example.org/é", "printable ASCII"),
    ],
)  # fmt: skip
def test_urls_that_are_none(url: str, reason: str) -> None:
    """The reason of a refusal is told."""
    with pytest.raises(ProblemError, match=reason):
        check_url(url, private=True)


def test_names_are_looked_up_when_a_webhook_is_sent() -> None:
    """A name that leads to a private address is refused then, and so is one without an address."""
    check_url("http://localhost/", private=False)

    async def look(url: str, **how: bool) -> tuple[str, int]:
        return await resolve(urlsplit(url), **how)

    with pytest.raises(ForbiddenAddressError, match="localhost leads to"):
        asyncio.run(look("http://localhost/", private=False))
    assert asyncio.run(look("https://localhost/", private=True))[1] == 443
    assert asyncio.run(look("http://8.8.8.8:81/", private=False)) == ("8.8.8.8", 81)
    with pytest.raises(ForbiddenAddressError, match="not known"):
        asyncio.run(look("http://name.invalid/", private=False))


@pytest.mark.parametrize("secret", ["", "secret", "whsec_", "whsec_c2hvcnQ=", "whsec_!!!!"])
def test_secrets_of_another_form(secret: str) -> None:
    """A secret that no library of the specification accepts is refused."""
    with pytest.raises(ValueError, match="must be whsec_"):
        Settings(webhook_secret=secret)
