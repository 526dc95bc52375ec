"""A process that gives up what it does not need, for good: memory, time, files, the network.

What every POSIX system has are limits; Linux also closes the network and all folders but the named ones
(Landlock, https://docs.kernel.org/userspace-api/landlock.html). To be called before there are threads:
both hold for the calling thread and what it starts.
"""

import ctypes
import os
import struct
import sys
from collections.abc import Sequence
from pathlib import Path

CLONE_NEWUSER, CLONE_NEWNET = 0x1000_0000, 0x4000_0000
PR_SET_NO_NEW_PRIVS = 38
CREATE_RULESET, ADD_RULE, RESTRICT_SELF = 444, 445, 446  # system calls, on every architecture
RULE_PATH_BENEATH = 1
EXECUTE, READ_FILE, READ_DIR = 1 << 0, 1 << 2, 1 << 3
# what each version of Landlock can refuse; in files, over TCP, and to processes outside
FILE_RIGHTS = {1: 13, 2: 14, 3: 15, 4: 15, 5: 16}
TCP, OUTSIDERS = 0b11, 0b11
MOST_FILES = 1024
# what Python and its libraries read; /etc and the home folders are not among it
SYSTEM = ("/usr", "/lib", "/lib64", "/etc/ld.so.cache", "/sys/devices/system/cpu", "/proc/self",
          "/proc/cpuinfo", "/proc/meminfo", "/dev/null", "/dev/urandom")  # fmt: skip


def limit(seconds: float, memory: int) -> None:
    """At most so many seconds of processor time and bytes of address space; no byte written to any
    file, no core dump. Raises ImportError where there are no such limits (Windows)."""
    import resource

    whole = max(1, round(seconds))
    for what, most in (
        (resource.RLIMIT_CPU, whole),
        (resource.RLIMIT_AS, memory),
        (resource.RLIMIT_FSIZE, 0),
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_NOFILE, MOST_FILES),
    ):
        hard = resource.getrlimit(what)[1]
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(what, (most, most))


def close_network() -> bool:
    """Leave for a network without any device. False where the system does not let us."""
    if not sys.platform.startswith("linux"):
        return False
    return ctypes.CDLL(None).unshare(CLONE_NEWUSER | CLONE_NEWNET) == 0


def close_files(folders: Sequence[str | Path]) -> bool:
    """Let nothing be opened but for reading, and nothing but what lies in the folders (or is one of
    the files) named, in Python's own, or in the system's libraries; no TCP, no signals to others. False
    where the kernel has no Landlock."""
    if not sys.platform.startswith("linux"):
        return False
    libc = ctypes.CDLL(None)
    version = libc.syscall(CREATE_RULESET, None, 0, 1)
    if version < 1:
        return False
    rights = (1 << FILE_RIGHTS[min(version, 5)]) - 1
    fields = [rights, *([TCP] if version >= 4 else []), *([OUTSIDERS] if version >= 6 else [])]
    attributes = struct.pack(f"={len(fields)}Q", *fields)
    rules = libc.syscall(CREATE_RULESET, attributes, ctypes.c_size_t(len(attributes)), 0)
    if rules < 0:
        return False
    for path in (*SYSTEM, *_python(), *folders):
        _allow(libc, rules, str(path))
    libc.prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
    closed = libc.syscall(RESTRICT_SELF, rules, 0) == 0
    os.close(rules)
    return closed


def _python() -> list[str]:
    """Folders of this Python, its packages and this package."""
    own = Path(__file__).parents[1]
    return [sys.prefix, sys.base_prefix, sys.exec_prefix, str(own)]


def _allow(libc: ctypes.CDLL, rules: int, path: str) -> None:
    """Reading beneath a path; what is not there needs no rule."""
    try:
        place = os.open(path, getattr(os, "O_PATH", 0) | os.O_CLOEXEC)
    except OSError:
        return
    try:
        rights = EXECUTE | READ_FILE | (READ_DIR if os.path.isdir(path) else 0)
        libc.syscall(ADD_RULE, rules, RULE_PATH_BENEATH, struct.pack("=Qi", rights, place), 0)
    finally:
        os.close(place)
