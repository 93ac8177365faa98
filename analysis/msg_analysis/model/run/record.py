"""The run record: everything that a run was started from, as one JSON document.

It is what every node of a run is given, what the latched ``experiment`` topic carries, and so what any bag of the
network holds, whoever recorded it.
"""

from __future__ import annotations

import json
import platform
import uuid
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from msg_analysis.common.version import __version__
from msg_analysis.errors import InputError
from msg_analysis.model.experiment.experiment import Experiment
from msg_analysis.model.experiment.protocol_binding import info_of
from msg_analysis.types import FloatArray

FORMAT = 1


def software_versions() -> dict[str, str]:
    """Versions of what computes a run's numbers, and where that is."""
    import scipy  # here, since the processes of a run only read their record

    return {
        "msg_analysis": __version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "machine": platform.machine(),
        "system": f"{platform.system()} {platform.release()}",
        "host": platform.node(),
    }


@dataclass(frozen=True, slots=True, eq=False)
class RunRecord:
    """One run of an experiment.

    Attributes
    ----------
    run
        run id
    experiment
        what is run
    start
        (m, width) x(0). Computed once and carried along, because it comes out of linear algebra whose last bits depend
        on the machine
    versions
        versions of the software that started the run, and the machine that it was started on
    """

    run: uuid.UUID
    experiment: Experiment
    start: FloatArray
    versions: dict[str, str] = field(default_factory=software_versions)

    def to_json(self) -> str:
        """The document; numbers survive the round trip to the last bit."""
        document: dict[str, Any] = {
            "format": FORMAT,
            "run": str(self.run),
            "experiment": self.experiment.to_document(),
            "start": self.start.tolist(),
            "versions": self.versions,
        }
        if self.experiment.protocol:
            document["protocol"] = self.experiment.protocol.info.to_json()
        return json.dumps(document)

    @classmethod
    def from_json(cls, text: str, source: str) -> RunRecord:
        """Read a run record.

        Parameters
        ----------
        text
            what ``to_json`` wrote
        source
            where it came from, for messages

        Raises
        ------
        InputError
            not a run record, of another format, or with an invalid experiment in it
        """
        try:
            document: Any = json.loads(text)
            if document["format"] != FORMAT:
                raise InputError(
                    f"{source}: run record of format {document['format']}, expected {FORMAT}: "
                    "read it with the version of msg_analysis that wrote it"
                )
            experiment = Experiment.parse(document["experiment"], source=source, recorded=info_of(document))
            start = np.array(document["start"], dtype=float)
            record = cls(uuid.UUID(document["run"]), experiment, start, dict(document["versions"]))
        except InputError:
            raise
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
            raise InputError(f"{source}: not a run record ({type(error).__name__}: {error})") from error
        expected = (experiment.agents, experiment.width)
        if start.shape != expected or not np.isfinite(start).all():
            raise InputError(f"{source}: start has shape {start.shape}, expected finite numbers of shape {expected}")
        return record
