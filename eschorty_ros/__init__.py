"""Event-based Scheimpflug LiDAR: camera, laser line and stage in, point cloud out."""

from pkgutil import extend_path

# The generated msg, srv and action modules live in an installed folder of the same name; this
# lets the sources be used in place beside them.
__path__ = extend_path(__path__, __name__)
__version__ = "0.1.0"
