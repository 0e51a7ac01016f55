"""Signatures of a pack by `ssh-keygen -Y`. The signed file is verdict.json, which contains the hashes of all other
files.
"""

from __future__ import annotations

import subprocess
from pathlib import Path

from maxq.tools.cli.frame import CommandError

NAMESPACE = "maxq-verdict"
SUFFIX = ".sig"


def _ssh_keygen(*words: str, given: bytes = b"") -> subprocess.CompletedProcess[bytes]:
    try:
        return subprocess.run(["ssh-keygen", "-Y", *words], input=given, capture_output=True, check=False)
    except OSError:
        raise CommandError("ssh-keygen is missing: install OpenSSH 8.1 or later to sign packs and check them") from None


def _said(done: subprocess.CompletedProcess[bytes]) -> str:
    return " ".join((done.stderr or done.stdout).decode(errors="replace").split())


def check_key(key: Path) -> None:
    """Sign an empty message, so that an unusable key is reported before the verification. Raises CommandError."""
    done = _ssh_keygen("sign", "-f", str(key), "-n", NAMESPACE)
    if done.returncode:
        raise CommandError(f"{key}: cannot sign: {_said(done)}")


def sign(file: Path, key: Path) -> Path:
    """Write the signature of a file next to it, and return its path. Raises CommandError."""
    signature = file.with_name(file.name + SUFFIX)
    signature.unlink(missing_ok=True)  # ssh-keygen would ask before it replaced a signature
    done = _ssh_keygen("sign", "-f", str(key), "-n", NAMESPACE, str(file))
    if done.returncode:
        raise CommandError(f"{key}: cannot sign {file}: {_said(done)}")
    return signature


def signer(file: Path, allowed: Path | None) -> tuple[bool, str]:
    """Verify the signature of a file. Return True if it is valid and of an allowed signer, and a sentence on it.

    `allowed` is a file of allowed signers (ssh-keygen(1)). Without it, any signer is accepted. Raises CommandError.
    """
    signature, content = str(file.with_name(file.name + SUFFIX)), file.read_bytes()
    if allowed is None:
        done = _ssh_keygen("check-novalidate", "-n", NAMESPACE, "-s", signature, given=content)
        return not done.returncode, f"{_said(done)} (any signer: --allowed FILE names those allowed)"
    found = _ssh_keygen("find-principals", "-s", signature, "-f", str(allowed))
    if found.returncode:
        return False, f"the signer is not in {allowed}: {_said(found)}"
    who = found.stdout.decode().split("\n")[0]
    words = ("-f", str(allowed), "-I", who, "-n", NAMESPACE, "-s", signature)
    done = _ssh_keygen("verify", *words, given=content)
    return not done.returncode, _said(done)
