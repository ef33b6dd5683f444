"""Runs programs in processes that are forked from this one, which has imported what takes seconds; see ``commands``."""

import contextlib
import gc
import json
import os
import runpy
import select
import signal
import sys
import traceback

import cv2  # noqa: F401
import matplotlib.pyplot  # noqa: F401

import dsr.app.entry
import dsr.app.evaluate
import dsr.app.report
import dsr.app.train
import dsr.app.upsample.run
import dsr.cli  # noqa: F401


def become(request):
    """Turn this process into that of a program, and end it as Python does."""
    os.setsid()
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["env"])
    for number, name in enumerate(("/dev/null", request["stdout"], request["stderr"])):
        file = os.open(name, os.O_RDONLY if number == 0 else os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(file, number)
        os.close(file)
    program, *arguments = request["arguments"]
    as_module = program == "-m"
    name = arguments.pop(0) if as_module else program
    paths = [path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path]
    sys.path[:] = [os.getcwd() if as_module else os.path.dirname(name), *paths, *sys.path[1:]]  # noqa: PTH109, PTH120
    sys.argv = [name, *arguments]
    code = 0
    try:
        (runpy.run_module if as_module else runpy.run_path)(name, run_name="__main__")
    except SystemExit as ending:
        code = ending.code if isinstance(ending.code, int) else int(ending.code is not None)
        if isinstance(ending.code, str):
            sys.stderr.write(f"{ending.code}\n")
    except BaseException:
        traceback.print_exc()
        code = 1
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def wait_for(process, seconds):
    """Return the exit code of a process, which is killed if it takes longer: None."""
    handle = os.pidfd_open(process)
    late = not select.select([handle], [], [], seconds)[0]
    os.close(handle)
    if late:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process, signal.SIGKILL)
    code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    return None if late else code


if __name__ == "__main__":
    gc.collect()
    gc.freeze()  # so that programs' garbage collections leave alone what they share with this process
    for line in sys.stdin:
        asked = json.loads(line)
        answer = wait_for(asked["process"], asked["timeout"]) if "process" in asked else os.fork()
        if answer == 0 and "process" not in asked:
            become(asked)
        sys.stdout.write(json.dumps(answer) + "\n")
        sys.stdout.flush()
