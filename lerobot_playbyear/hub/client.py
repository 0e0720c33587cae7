"""The Hub's client, with patience: what only asks is asked again when it failed for a passing reason.

`huggingface_hub` repeats some requests (preparing an upload, parts of files) and not others (looking a repository up), so
that one lost request ends a download of hundreds. What starts, creates or changes something is never repeated here: its
answer may have been lost after it was done. `pushing` knows which of these can be done again, and how.
"""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import httpx
from huggingface_hub import constants, set_client_factory

from lerobot_playbyear.compat import hub_client_factory

_WAITS_S = (0.5, 1.0, 2.0)
_PASSING = (500, 502, 503, 504)
_ASKING = ("GET", "HEAD", "OPTIONS")
_CARD_CHECK = "/api/validate-yaml"  # a POST that changes nothing
_PUBLIC_HUB = "huggingface.co"
_CHANGING = threading.Lock()  # of the library's one client, which threads share


class PatientClient(httpx.Client):
    """Makes requests through another client; one that only asks up to four times while the network or the server fails.

    Cards are validated at huggingface.co, whatever `HF_ENDPOINT` says; here they are validated where they go.

    Args:
        usual: The other client: its proxies, certificates, headers and hooks stay in use.
    """

    def __init__(self, usual: httpx.Client) -> None:
        super().__init__()
        self._usual = usual

    def build_request(self, *args: Any, **kwargs: Any) -> httpx.Request:
        """As the other client builds it."""
        return self._usual.build_request(*args, **kwargs)

    def send(self, request: httpx.Request, **kwargs: Any) -> httpx.Response:
        """As `httpx.Client.send`."""
        _address_endpoint(request)
        waits = list(_WAITS_S) if _only_asks(request) else []
        while True:
            try:
                response = self._usual.send(request, **kwargs)
            except httpx.TransportError:
                if not waits:
                    raise
            else:
                if not waits or response.status_code not in _PASSING:
                    return response
                response.close()
            time.sleep(waits.pop(0))

    def close(self) -> None:
        """Closes the other client, too."""
        self._usual.close()
        super().close()


class _PatientFactory:
    """Makes patient clients.

    Args:
        usual: Makes the clients that they use.

    Attributes:
        n_users: How many are at work with it, of this thread and others.
    """

    def __init__(self, usual: Callable[[], httpx.Client]) -> None:
        self.usual, self.n_users = usual, 0

    def __call__(self) -> httpx.Client:
        return PatientClient(self.usual())


@contextmanager
def patient_hub() -> Iterator[None]:
    """Lets what talks to the Hub in this process do so with patience, until the work is done or has failed."""
    with _CHANGING:
        factory = hub_client_factory()
        if not isinstance(factory, _PatientFactory):
            factory = _PatientFactory(factory)
            set_client_factory(factory)
        factory.n_users += 1
    try:
        yield
    finally:
        with _CHANGING:
            factory.n_users -= 1
            if factory.n_users == 0:
                set_client_factory(factory.usual)


def _only_asks(request: httpx.Request) -> bool:
    return request.method in _ASKING or (request.method == "POST" and request.url.path == _CARD_CHECK)


def _address_endpoint(request: httpx.Request) -> None:
    endpoint = httpx.URL(constants.ENDPOINT)
    if request.url.host == _PUBLIC_HUB != endpoint.host:
        request.url = request.url.copy_with(scheme=endpoint.scheme, host=endpoint.host, port=endpoint.port)
        request.headers["Host"] = request.url.netloc.decode()
