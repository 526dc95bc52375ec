"""Other people's scenes: read into plain parts and materials, then written as a USD scene of rfsg.

Each format has a module that turns a file into an ``Imported``: ``mitsuba`` (as Sionna RT writes them),
``meshes`` (obj, ply, glb, gltf, stl), ``floorplan`` (GeoJSON or plain JSON). Nothing in them knows of USD;
``rfsg.scene.usd.importing`` writes what they read. USD scenes with another program's materials
(``aerial``, ``simready``) stay as they are: a layer over them says what their materials are to a wave.
"""

from rfsg.scene.importers.api import ImportReport, import_scene

__all__ = ["ImportReport", "import_scene"]
