"""The machine as files for other programs: meshes of its links, and SDF (extra ``trajectory``)."""

from coop_env.exports.meshes import Link, links, save_glb, save_stl
from coop_env.exports.sdf import save_sdf

__all__ = ["Link", "links", "save_glb", "save_sdf", "save_stl"]
