# SPDX-License-Identifier: Apache-2.0
"""Collection of the bytes of an answer from the workers onto the disk of the front."""

from dataclasses import dataclass

from pugeo_service.engine.backend import Handle
from pugeo_service.engine.dispatch import Dispatch
from pugeo_service.engine.errors import EngineLostError, disk_errors
from pugeo_service.engine.messages import OutputInfo
from pugeo_service.engine.output_stages import read_chunk
from pugeo_service.engine.values import Output, Prepared
from pugeo_service.storage.shared_file import SharedFile
from pugeo_service.storage.spool import Spool

__all__ = ["Collector"]


@dataclass(frozen=True)
class Collector:
    """Puts an answer on disk here, so that no worker waits for a slow client.

    Attributes:
        spool: the bytes so far.
        file: reference to the spool by which workers of this machine write into it.
        tasks: of the request.
    """

    spool: Spool
    file: SharedFile
    tasks: Dispatch

    async def collect(self, source: Handle[Output] | Handle[Prepared], info: OutputInfo) -> None:
        """Append bytes in chunks of 8 MiB, so that memory does not grow with the answer.

        Args:
            source: the answer, a part of it, or a cloud that was upsampled when it was read.
            info: description of these bytes.

        Raises:
            EngineLostError: the bytes are not those that were described.
            DiskError: there is no room for them.
        """
        done = await self._take(info.first)
        while done < info.size:
            handle = self.tasks.submit(read_chunk, source, done, self.file, self.spool.size)
            count = await self._take(await self.tasks.fetch(handle))
            self.tasks.drop(handle)
            done += count
            if not count or done > info.size:
                # The worker was lost, and another one made the bytes again with another length.
                raise EngineLostError("a part of the answer changed while it was brought here")

    async def flush(self) -> None:
        """Write buffered bytes: a full disk then shows before the answer begins."""
        with disk_errors():
            await self.spool.flush()

    async def _take(self, data: bytes | int) -> int:
        with disk_errors():
            return await self.spool.take(data)
