"""Sets on the Hugging Face hub, as the http address of one commit: its file system reads 5 MB ahead of every range."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from importlib import import_module
from typing import Any, Final
from urllib.parse import unquote

from bodyseg_data.core import BadConfig
from bodyseg_data.machine import missing_library
from bodyseg_data.shards.transport import TRANSIENT_STATUSES, PermanentFailure, TransientFailure

_FOLDER: Final = re.compile(r"hf://datasets/([^/@]+/[^/@]+)(?:@([^/]+))?((?:/.*)?)")


def pinned(url: str, options: Mapping[str, Any], timeout_s: float) -> tuple[str, str, dict[str, Any]]:
    """The address of a folder with its commit for a revision, that of http, and options for that.

    options: `token` and `endpoint` (else HF_TOKEN, HF_ENDPOINT), and those of http addresses. Raises BadConfig for
    another address, MissingLibrary, TransientFailure, PermanentFailure.
    """
    match = _FOLDER.fullmatch(url)
    if match is None:
        raise BadConfig(f"an address of the hub must be hf://datasets/OWNER/NAME[@REVISION][/FOLDER], found {url}")
    try:
        hub = import_module("huggingface_hub")
    except ImportError as error:
        raise missing_library("hf:// addresses", error, extra="hub") from error
    name, revision, rest = match[1], unquote(match[2] or "main"), dict(options)
    token, endpoint = rest.pop("token", None), rest.pop("endpoint", None) or os.environ.get("HF_ENDPOINT")
    api = hub.HfApi(endpoint=endpoint, token=token)
    try:
        commit = str(api.dataset_info(name, revision=revision, timeout=timeout_s).sha)
    except Exception as error:  # of the hub, and of the library that it connects by
        status = getattr(getattr(error, "response", None), "status_code", None)
        passes = status in TRANSIENT_STATUSES if status else not isinstance(error, ValueError)
        asked = f"{status} for revision {revision!r}: is it there, and may the token (HF_TOKEN) read it?"
        raise (TransientFailure if passes else PermanentFailure)(asked if status else repr(error)) from None
    if not re.fullmatch("[0-9a-f]{40}", commit):
        raise PermanentFailure(f"the hub must name a commit of 40 digits, found {commit[:60]!r}")
    headers = {**hub.utils.build_hf_headers(token=token), **rest.pop("headers", {})}
    address = hub.hf_hub_url(name, match[3].strip("/"), repo_type="dataset", revision=commit, endpoint=api.endpoint)
    return f"hf://datasets/{name}@{commit}{match[3].rstrip('/')}", address.rstrip("/"), {**rest, "headers": headers}
