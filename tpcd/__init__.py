"""tpcd: tactile probabilistic contact dynamics estimation of unknown objects.

Data flows `shape` and `terrain` -> `contact` -> `qp` -> `simulator` -> `belief` ->
`predict`; `data` stands at the edge. Importing this package loads nothing heavy.
"""

__version__ = "0.1.0"
