# SPDX-License-Identifier: Apache-2.0
"""The bytes of an answer, from the workers that wrote them to the disk of the front."""

from dataclasses import dataclass
from typing import Any

from pugeo_service.engine.dispatch import Dispatch
from pugeo_service.engine.errors import EngineLostError, disk
from pugeo_service.engine.messages import Sheet
from pugeo_service.storage.shared_file import SharedFile
from pugeo_service.storage.spool import Spool

__all__ = ["Collector"]


@dataclass(frozen=True)
class Collector:
    """Puts all on disk here, so that no worker waits for a slow client.

    Attributes:
        spool: the bytes so far.
        file: how workers of this machine put bytes there themselves.
        tasks: of the request.
    """

    spool: Spool
    file: SharedFile
    tasks: Dispatch

    async def collect(self, written: Any, sheet: Sheet) -> None:
        """Append what was written, a chunk at a time: little is in memory whatever the size.

        Raises:
            EngineLostError: it is no longer what was told of.
            DiskError: there is no room for it.
        """
        done = await self._take(sheet.first)
        while done < sheet.size:
            handle = self.tasks.submit("chunk", written, done, self.file, self.spool.size)
            came = await self._take(await self.tasks.fetch(handle))
            self.tasks.drop([handle])
            done += came
            if not came or done > sheet.size:
                # It was lost with its worker, and another made it anew, of another length.
                raise EngineLostError("a part of the answer changed while it was brought here")

    async def flush(self) -> None:
        """Find out that the disk has no room before the answer begins."""
        with disk():
            await self.spool.flush()

    async def _take(self, came: bytes | int) -> int:
        with disk():
            return await self.spool.take(came)
