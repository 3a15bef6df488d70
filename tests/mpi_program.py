"""Commands of biem under one mpirun, one after the other: `mpirun -n 2 python tests/mpi_program.py FOLDER`.

FOLDER/commands.json lists their arguments. What the processes print together goes to K.out and K.err, the exit code of each to K.RANK.code.
"""

import json
import os
import sys
from pathlib import Path

from biem.__main__ import app


def main(folder):
    for k, arguments in enumerate(json.loads((folder / "commands.json").read_text())):
        for stream, name in ((sys.stdout, "out"), (sys.stderr, "err")):
            file = os.open(folder / f"{k}.{name}", os.O_CREAT | os.O_WRONLY | os.O_APPEND)
            os.dup2(file, stream.fileno())
            os.close(file)
        code = 0
        try:
            app(arguments)
        except SystemExit as end:
            code = end.code or 0
        sys.stdout.flush()
        sys.stderr.flush()
        (folder / f"{k}.{os.environ['PMI_RANK']}.code").write_text(str(code))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
