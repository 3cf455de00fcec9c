"""What pages with scripts need to be safe and complete in themselves."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Sequence


def embedded_json(value: object) -> str:
    """Returns JSON that can stand inside a script element, whatever names it holds."""
    text = json.dumps(value, separators=(",", ":"))
    for sign in "<>&":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return text


def inline_scripts(sources: Sequence[str]) -> list[str]:
    """Returns scripts as they can stand inside script elements."""
    # An end tag inside a string of a script would end its element.
    return [source.replace("</script", "<\\/script") for source in sources]


def security_policy(scripts: Sequence[str]) -> str:
    """Returns the Content-Security-Policy: only these scripts run, and no network is asked."""
    allowed = []
    for script in scripts:
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        allowed.append(f"'sha256-{digest}'")
    return (
        f"default-src 'none'; script-src {' '.join(allowed)}; style-src 'unsafe-inline';"
        " img-src data: blob:; base-uri 'none'; form-action 'none'"
    )
