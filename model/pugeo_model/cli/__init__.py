# SPDX-License-Identifier: Apache-2.0
"""The command `pugeo`.

========================================================  ======================================
module                                                    content
========================================================  ======================================
``app``                                                   the commands together, and their errors
``upsample``                                              ``pugeo upsample``
``info``, ``models``, ``samples``                         the commands of these names
``train``, ``evaluate``, ``reproduce``                    likewise
``inputs``, ``outputs``                                   files, folders and patterns to tasks
``tasks``                                                 one file to upsample, and its outcome
``local``, ``remote``                                     run tasks here, or on a service
``display``, ``summary``                                  progress and results for people, JSON
========================================================  ======================================

Other packages add subcommands by entry points in ``pugeo.commands``, and the way to a service by
one in ``pugeo.services``.
"""

from pugeo_model.cli.app import app, main

__all__ = ["app", "main"]
