# SPDX-License-Identifier: Apache-2.0
"""Private names of uvicorn and distributed that the service uses exist."""

import asyncio
import inspect

import dask
import distributed
import pytest
import uvicorn
from distributed import scheduler
from distributed.diagnostics.plugin import SchedulerPlugin
from distributed.worker_state_machine import WorkerState
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol, RequestResponseCycle
from uvicorn.server import ServerState

from pugeo_service.engine.dask_config import CONFIG
from pugeo_service.engine.retries import ReportRetries
from pugeo_service.http.lingering_close import LingeringClose
from pugeo_service.http.protocol import ServerProtocol
from pugeo_service.http.request_limits import RequestLimits


def test_methods_of_the_protocol() -> None:
    """Each overridden method exists in uvicorn's protocol, except our own helpers."""
    helpers = {
        "_start_timer", "_cancel_timer", "_on_timeout", "_start_read_timer", "_check_reader",
        "_cancel_linger_timer", "_cancel_read_timer", "_unread", "guarded", "_linger", "_on_idle",
        "_cancel_timers",
    }  # fmt: skip
    for kind in (LingeringClose, RequestLimits, ServerProtocol):
        methods = {name for name, value in vars(kind).items() if inspect.isfunction(value)}
        assert methods - helpers
        assert [name for name in methods - helpers if not hasattr(HttpToolsProtocol, name)] == []


def test_attributes_of_the_protocol() -> None:
    """Uvicorn's protocol and its requests have the attributes that ours read."""
    loop = asyncio.new_event_loop()
    config = uvicorn.Config(lambda: None, http=HttpToolsProtocol, log_config=None)
    config.load()
    protocol = HttpToolsProtocol(config, ServerState(), {}, loop)
    for name in ("connections", "cycle", "pipeline", "loop", "transport"):
        assert hasattr(protocol, name), name
    loop.close()
    source = inspect.getsource(RequestResponseCycle.__init__)
    for name in ("response_started", "response_complete", "disconnected", "more_body"):
        assert f"self.{name}" in source, name
    assert "self.message_event" in source


def test_names_of_the_server() -> None:
    """Uvicorn's server has the methods and attributes that ours replaces."""
    server = uvicorn.Server(uvicorn.Config(lambda: None, log_config=None))
    for name in ("capture_signals", "handle_exit", "should_exit", "force_exit"):
        assert hasattr(server, name), name


@pytest.mark.parametrize("key", sorted(CONFIG))
def test_configuration_of_dask(key: str) -> None:
    """Each configured key, or its parent where Dask allows any key, has a default."""
    parent = key.rpartition(".")[0] if "environ" in key else key
    missing = object()
    assert dask.config.get(parent, missing) is not missing


def test_names_of_dask() -> None:
    """Worker state, scheduler, client and plugin have the names that the backend uses."""
    assert "spans" in scheduler.DEFAULT_EXTENSIONS
    for status in ("running", "closed", "failed"):
        assert hasattr(distributed.Status, status), status
    state = WorkerState(nthreads=1)
    for name in ("total_resources", "available_resources", "nthreads"):
        assert hasattr(state, name), name
    worker = inspect.getsource(distributed.Worker.__init__)
    assert "self.executors" in worker
    assert "self.periodic_callbacks" in inspect.getsource(distributed.core.Server.__init__)
    for name in ("register_plugin", "subscribe_topic", "wait_for_workers", "submit", "gather"):
        assert hasattr(distributed.Client, name), name
    assert "n_workers" in inspect.signature(scheduler.Scheduler.identity).parameters
    assert "self._created" in inspect.getsource(distributed.SpecCluster.__init__)
    assert "self.process" in inspect.getsource(distributed.Nanny.__init__)
    for name in ("worker_address", "pid"):
        assert hasattr(distributed.Nanny, name), name
    assert "self.process" in inspect.getsource(distributed.nanny.WorkerProcess.__init__)
    assert hasattr(distributed.process.AsyncProcess, "pid")
    assert hasattr(scheduler.Scheduler, "valid_workers")
    assert '"resource_restrictions"' in inspect.getsource(scheduler.Scheduler._task_to_msg)
    states = inspect.getsource(scheduler.TaskState)
    for name in ("worker_restrictions", "loose_restrictions", "resource_restrictions"):
        assert f"{name}:" in states, name
    for name in ("retire_workers", "identity", "remove_worker"):
        assert hasattr(scheduler.Scheduler, name), name
    removed = inspect.getsource(scheduler.Scheduler.remove_worker)
    for member in ('"action": "remove-worker"', '"expected": expected', '["worker"] = address'):
        assert member in removed, member
    for name in ("worker_address", "finished", "close", "_unregister"):
        assert hasattr(distributed.Nanny, name), name
    assert "self.handlers" in inspect.getsource(distributed.core.Server.__init__)
    assert "timeout" in inspect.signature(distributed.Nanny.kill).parameters
    assert scheduler.heartbeat_interval(1) <= 1.0
    assert {"last_seen", "nanny"} <= set(scheduler.WorkerState.__slots__)
    for name in vars(ReportRetries):
        if inspect.isfunction(vars(ReportRetries)[name]) and name != "__init__":
            assert hasattr(SchedulerPlugin, name), name
