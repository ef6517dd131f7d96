"""ROS programs of tests, each a process: it answers requests, one line of JSON each."""

import json
import subprocess
import sys

from tests.support.live.processes import REPOSITORY

DOMAIN_ID = 81


class Program:
    """A started program that is ready."""

    def __init__(self, transport, module, *arguments):
        command = [sys.executable, "-m", module, str(DOMAIN_ID), "--transport", transport, *arguments]
        pipe, none = subprocess.PIPE, subprocess.DEVNULL
        self._process = subprocess.Popen(
            command, cwd=REPOSITORY, stdin=pipe, stdout=pipe, stderr=none, text=True
        )
        assert self._process.stdout.readline() == "ready\n"

    def ask(self, kind, seconds=2.0):
        """Let a stranger act for a while."""
        self._process.stdin.write(json.dumps({"kind": kind, "seconds": seconds, "seed": 0}) + "\n")
        self._process.stdin.flush()

    def terminate(self):
        """End it as a person does."""
        self._process.terminate()

    def close(self):
        """End it at once."""
        self._process.kill()
        self._process.communicate()
