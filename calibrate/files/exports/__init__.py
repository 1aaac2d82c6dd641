"""What other programs read: one module per format, each the text of a file made from a calibration."""

from calibrate.files.exports.registry import FORMATS, ExportError, export

__all__ = ["FORMATS", "ExportError", "export"]
