"""The client of our commands for the Hub: what only asks is asked again when it failed for a passing reason."""

import contextlib
import time
from typing import Any

import httpx
from huggingface_hub import get_session, set_client_factory

_WAITS_S = (0.5, 1.0, 2.0)
_ASKING = ("GET", "HEAD", "OPTIONS")


class PatientClient(httpx.Client):
    """The Hub's client, where a request that only asks is made up to four times while the network or the server fails.

    `huggingface_hub` repeats some requests by itself, and not those that look a repository up, so that one lost request ends
    a download of hundreds.
    """

    def send(self, request: httpx.Request, **kwargs: Any) -> httpx.Response:
        """As `httpx.Client.send`."""
        for wait_s in _WAITS_S if request.method in _ASKING else ():
            with contextlib.suppress(httpx.TransportError):
                response = super().send(request, **kwargs)
                if response.status_code < 500:
                    return response
                response.close()
            time.sleep(wait_s)
        return super().send(request, **kwargs)


def be_patient() -> None:
    """Lets all of this process, a command of ours, talk to the Hub by a `PatientClient`."""
    hooks = get_session().event_hooks  # for HF_HUB_OFFLINE
    set_client_factory(lambda: PatientClient(event_hooks=hooks, follow_redirects=True, timeout=None))
