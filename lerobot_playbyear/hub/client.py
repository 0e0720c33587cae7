"""The Hub's client, with patience: a request that failed for a passing reason is made again.

`huggingface_hub` repeats some requests (parts of files) and not others (looking a repository up, making a commit), so that
one lost request ends an upload or a download of hundreds.
"""

import time
from functools import partial
from typing import Any

import httpx
from huggingface_hub import constants, set_client_factory
from huggingface_hub.utils import get_session

_WAITS_S = (0.5, 1.0, 2.0)
_PASSING = (500, 502, 503, 504)
_PUBLIC_HUB = "huggingface.co"


class PatientClient(httpx.Client):
    """Makes a request up to four times while the network or the server fails.

    Cards are validated at huggingface.co, whatever `HF_ENDPOINT` says; here they are validated where they go.
    """

    def send(self, request: httpx.Request, **kwargs: Any) -> httpx.Response:
        """As `httpx.Client.send`. A body that is read from a file while it is sent is not sent again: the caller does that."""
        _address_endpoint(request)
        waits = list(_WAITS_S) if _is_repeatable(request) else []
        while True:
            try:
                response = super().send(request, **kwargs)
            except httpx.TransportError:
                if not waits:
                    raise
            else:
                if not waits or response.status_code not in _PASSING:
                    return response
                response.close()
            time.sleep(waits.pop(0))


def use_patient_client() -> None:
    """Lets everything in this process that talks to the Hub do so with patience. For commands, not for libraries."""
    usual = get_session()
    if not isinstance(usual, PatientClient):
        hooks, follow, timeout = usual.event_hooks, usual.follow_redirects, usual.timeout
        set_client_factory(partial(PatientClient, event_hooks=hooks, follow_redirects=follow, timeout=timeout))


def _is_repeatable(request: httpx.Request) -> bool:
    try:
        _ = request.content
    except httpx.RequestNotRead:
        return False
    return True


def _address_endpoint(request: httpx.Request) -> None:
    endpoint = httpx.URL(constants.ENDPOINT)
    if request.url.host == _PUBLIC_HUB != endpoint.host:
        request.url = request.url.copy_with(scheme=endpoint.scheme, host=endpoint.host, port=endpoint.port)
        request.headers["Host"] = request.url.netloc.decode()
