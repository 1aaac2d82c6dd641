"""Black shapes on a sheet, in millimetres, as SVG and as PDF: one list, so that the two cannot differ."""

from __future__ import annotations

from dataclasses import dataclass
from xml.sax.saxutils import escape

_POINT_MM = 72 / 25.4


@dataclass(frozen=True)
class Rectangle:
    """Millimetres from the top left."""

    x: float
    y: float
    width: float
    height: float


@dataclass(frozen=True)
class Circle:
    x: float
    y: float
    radius: float


@dataclass(frozen=True)
class Line:
    """Text, its baseline's start."""

    x: float
    y: float
    size: float
    text: str


Shape = Rectangle | Circle | Line


@dataclass(frozen=True)
class Sheet:
    width_mm: float
    height_mm: float
    shapes: tuple[Shape, ...]


def moved(shape: Shape, dx: float, dy: float) -> Shape:
    if isinstance(shape, Rectangle):
        return Rectangle(shape.x + dx, shape.y + dy, shape.width, shape.height)
    if isinstance(shape, Circle):
        return Circle(shape.x + dx, shape.y + dy, shape.radius)
    return Line(shape.x + dx, shape.y + dy, shape.size, shape.text)


def svg(sheet: Sheet) -> str:
    """SVG text whose size is stated in mm."""
    parts = []
    for shape in sheet.shapes:
        if isinstance(shape, Rectangle):
            parts.append(
                f'<rect x="{shape.x:.4f}" y="{shape.y:.4f}" width="{shape.width:.4f}" '
                f'height="{shape.height:.4f}"/>'
            )
        elif isinstance(shape, Circle):
            parts.append(f'<circle cx="{shape.x:.4f}" cy="{shape.y:.4f}" r="{shape.radius:.4f}"/>')
        else:
            parts.append(
                f'<text x="{shape.x:.3f}" y="{shape.y:.3f}" font-family="Helvetica, Arial, sans-serif" '
                f'font-size="{shape.size:.2f}">{escape(shape.text)}</text>'
            )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{sheet.width_mm:.3f}mm" '
        f'height="{sheet.height_mm:.3f}mm" '
        f'viewBox="0 0 {sheet.width_mm:.3f} {sheet.height_mm:.3f}" shape-rendering="crispEdges">\n'
        f'<rect width="100%" height="100%" fill="white"/>\n<g fill="black">\n'
        + "\n".join(parts)
        + "\n</g>\n</svg>\n"
    )


def pdf(sheet: Sheet) -> bytes:
    """PDF 1.4 with one page of the sheet's true size; vector shapes, built-in Helvetica."""
    content = _pdf_content(sheet)
    width, height = sheet.width_mm * _POINT_MM, sheet.height_mm * _POINT_MM
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width:.4f} {height:.4f}] /Contents 4 0 R "
        "/Resources << /Font << /F1 5 0 R >> >> >>".encode(),
        b"<< /Length " + str(len(content)).encode() + b" >>\nstream\n" + content + b"\nendstream",
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
    ]
    file = bytearray(b"%PDF-1.4\n")
    offsets = []
    for number, body in enumerate(objects, 1):
        offsets.append(len(file))
        file += f"{number} 0 obj\n".encode() + body + b"\nendobj\n"
    start = len(file)
    file += f"xref\n0 {len(objects) + 1}\n0000000000 65535 f \n".encode()
    file += "".join(f"{offset:010d} 00000 n \n" for offset in offsets).encode()
    file += f"trailer\n<< /Size {len(objects) + 1} /Root 1 0 R >>\nstartxref\n{start}\n%%EOF\n".encode()
    return bytes(file)


def _pdf_content(sheet: Sheet) -> bytes:
    lines = ["0 g"]
    for shape in sheet.shapes:
        if isinstance(shape, Rectangle):
            x, y = shape.x * _POINT_MM, (sheet.height_mm - shape.y - shape.height) * _POINT_MM
            lines.append(f"{x:.4f} {y:.4f} {shape.width * _POINT_MM:.4f} {shape.height * _POINT_MM:.4f} re f")
        elif isinstance(shape, Circle):
            lines.append(_pdf_circle(shape, sheet.height_mm))
        else:
            x, y = shape.x * _POINT_MM, (sheet.height_mm - shape.y) * _POINT_MM
            text = shape.text.replace("\\", "\\\\").replace("(", "\\(").replace(")", "\\)")
            lines.append(f"BT /F1 {shape.size * _POINT_MM:.3f} Tf {x:.4f} {y:.4f} Td ({text}) Tj ET")
    return "\n".join(lines).encode("cp1252", "replace")


def _pdf_circle(shape: Circle, height_mm: float) -> str:
    """Four Bézier arcs, off by less than 0.03 % of the radius."""
    x, y, r = shape.x * _POINT_MM, (height_mm - shape.y) * _POINT_MM, shape.radius * _POINT_MM
    k = 0.5522847498 * r
    arcs = (
        (x + r, y + k, x + k, y + r, x, y + r),
        (x - k, y + r, x - r, y + k, x - r, y),
        (x - r, y - k, x - k, y - r, x, y - r),
        (x + k, y - r, x + r, y - k, x + r, y),
    )
    drawn = " ".join(" ".join(f"{v:.4f}" for v in arc) + " c" for arc in arcs)
    return f"{x + r:.4f} {y:.4f} m {drawn} f"
