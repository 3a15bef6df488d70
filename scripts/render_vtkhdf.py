"""A picture of a VTKHDF export by VTK, without a display: membranes with the tension in colour, over a field, with walls and tracers.

python scripts/render_vtkhdf.py out/pair.vtkhdf -o pair.png --field pressure

What `python -m biem export --vtkhdf` has written beside the file (NAME.grid.vtkhdf, NAME.walls.vtkhdf, NAME.tracers.vtkhdf) is read as
well, with the vtkHDFReader that ParaView uses. VTK 9.3 or newer; where there is no X server, its wheels render through EGL from 9.4 on.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np

WIDTH, MARGIN = 1200, 1.03  # pixels; of the view over what is in it
BAR = 0.1  # height of the strip for the colour bars, over the width
SHARE = 0.01  # of the values, at either end, that colours leave out
DIVERGING = ((0.0, 0.02, 0.19, 0.38), (0.25, 0.26, 0.58, 0.76), (0.5, 0.97, 0.97, 0.97), (0.75, 0.84, 0.38, 0.30), (1.0, 0.40, 0.0, 0.12))
SEQUENTIAL = ((0.0, 0.99, 0.99, 0.97), (0.33, 0.70, 0.82, 0.89), (0.67, 0.25, 0.55, 0.74), (1.0, 0.03, 0.19, 0.42))
WARM = ((0.0, 0.16, 0.04, 0.33), (0.35, 0.58, 0.15, 0.40), (0.7, 0.93, 0.41, 0.14), (1.0, 0.99, 0.91, 0.30))


def read(path: Path, t: float | None) -> tuple[Any, list[float]]:
    """The data at the last step, or at the step closest to t, and the times of all steps."""
    from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline
    from vtkmodules.vtkIOHDF import vtkHDFReader

    reader = vtkHDFReader()
    if not path.is_file() or not reader.CanReadFile(str(path)):
        raise ValueError(f"{path} is no VTKHDF file: expected what `python -m biem export --vtkhdf` writes")
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    times = list(reader.GetOutputInformation(0).Get(vtkStreamingDemandDrivenPipeline.TIME_STEPS()) or [0.0])
    reader.UpdateTimeStep(times[-1] if t is None else min(times, key=lambda one: abs(one - t)))
    data = reader.GetOutputDataObject(0)
    if data.GetNumberOfPoints() == 0:
        raise ValueError(f"{path} has no points")
    return data, times


def values_of(data: Any, name: str) -> np.ndarray:
    """Point data as an array; the length of vectors. Raises ValueError for a name that there is not."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    array = data.GetPointData().GetArray(name)
    if array is None:
        known = [data.GetPointData().GetArrayName(i) for i in range(data.GetPointData().GetNumberOfArrays())]
        raise ValueError(f'there is no "{name}": expected one of {", ".join(known) or "none"}')
    values = vtk_to_numpy(array)
    return values if values.ndim == 1 else np.linalg.norm(values, axis=-1)


def colours(values: np.ndarray, anchors: tuple[tuple[float, ...], ...], symmetric: bool) -> Any:
    """A table for the values, from and to their quantiles."""
    from vtkmodules.vtkRenderingCore import vtkColorTransferFunction

    low, high = np.nanquantile(values, [SHARE, 1.0 - SHARE])
    if symmetric:
        low, high = -max(-low, high), max(-low, high)
    table = vtkColorTransferFunction()
    for place, *rgb in anchors:
        table.AddRGBPoint(low + place * (high - low or 1.0), *rgb)
    table.SetNanColor(0.85, 0.85, 0.85)
    return table


def actor_of(data: Any, values: np.ndarray | None, table: Any, line: float, colour: tuple[float, float, float] = (0.2, 0.2, 0.2)) -> Any:
    """The data with values at its points in colours of the table, or in one colour; line: width, or size of points, in pixels."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkRenderingCore import vtkActor, vtkDataSetMapper

    mapper, actor = vtkDataSetMapper(), vtkActor()
    mapper.SetScalarVisibility(values is not None)
    if values is not None:
        array = numpy_to_vtk(values, deep=True)
        array.SetName("shown")
        data.GetPointData().SetScalars(array)
        mapper.SetLookupTable(table)
        mapper.UseLookupTableScalarRangeOn()
        mapper.InterpolateScalarsBeforeMappingOn()
    mapper.SetInputDataObject(data)
    actor.SetMapper(mapper)
    actor.GetProperty().SetLineWidth(line)
    actor.GetProperty().SetPointSize(line)
    actor.GetProperty().SetColor(*colour)
    actor.GetProperty().LightingOff()
    return actor


def bar_of(table: Any, title: str, left: float, height: float) -> Any:
    """A horizontal colour bar in the strip below the picture, of the given share of its height."""
    from vtkmodules.vtkRenderingAnnotation import vtkScalarBarActor

    bar = vtkScalarBarActor()
    bar.SetLookupTable(table)
    bar.SetTitle(title)
    bar.SetOrientationToHorizontal()
    bar.SetNumberOfLabels(3)
    bar.SetMaximumNumberOfColors(256)
    bar.SetTextPositionToPrecedeScalarBar()
    bar.SetVerticalTitleSeparation(8)
    bar.SetPosition(left, 0.1 * height)
    bar.SetWidth(0.4)
    bar.SetHeight(0.85 * height)
    bar.UnconstrainedFontSizeOn()
    for text, size in ((bar.GetTitleTextProperty(), 22), (bar.GetLabelTextProperty(), 20)):
        text.SetColor(0.0, 0.0, 0.0)
        text.SetFontSize(size)
        text.ItalicOff()
        text.BoldOff()
        text.ShadowOff()
    bar.SetLabelFormat("{:.3g}" if _new_formats() else "%.3g")
    return bar


def _new_formats() -> bool:
    """From 9.6 on VTK formats numbers as std::format does."""
    from vtkmodules.vtkCommonCore import vtkVersion

    return (vtkVersion.GetVTKMajorVersion(), vtkVersion.GetVTKMinorVersion()) >= (9, 6)


def render(path: Path, output: Path, field: str | None, colour: str | None, t: float | None) -> list[float]:
    """Draws the export at t (default its end) into a PNG; returns the times of its steps."""
    import vtkmodules.vtkRenderingOpenGL2  # noqa: F401  # what renders
    from vtkmodules.vtkIOImage import vtkPNGWriter
    from vtkmodules.vtkRenderingCore import vtkRenderer, vtkRenderWindow, vtkWindowToImageFilter

    membranes, times = read(path, t)
    beside = {name: path.with_suffix(f".{name}.vtkhdf") for name in ("grid", "walls", "tracers")}
    renderer, bars = vtkRenderer(), []
    bounds = list(membranes.GetBounds())
    if field is not None:
        grid, _ = read(beside["grid"], t)
        values = values_of(grid, field)
        signed = bool(np.nanmin(values) < 0.0)
        table = colours(values, DIVERGING if signed else SEQUENTIAL, signed and field != "pressure")
        actor = actor_of(grid, values, table, 1.0)
        actor.SetPosition(0.0, 0.0, -1e-3 * (bounds[1] - bounds[0]))
        renderer.AddActor(actor)
        bars.append((table, "speed" if field == "velocity" else field))
        bounds = list(grid.GetBounds())
    if beside["walls"].is_file():
        walls, _ = read(beside["walls"], None)
        renderer.AddActor(actor_of(walls, None, None, 4.0))
        bounds = list(walls.GetBounds()) if field is None else bounds
    if beside["tracers"].is_file():
        renderer.AddActor(actor_of(read(beside["tracers"], t)[0], None, None, 6.0, (0.1, 0.45, 0.1)))
    if colour is None:
        renderer.AddActor(actor_of(membranes, None, None, 4.0))
    else:
        values = values_of(membranes, colour)
        table = colours(values, WARM, False)
        renderer.AddActor(actor_of(membranes, values, table, 3.5))
        bars.append((table, f"{colour} of the membranes"))

    width, height = (bounds[1] - bounds[0]) * MARGIN, (bounds[3] - bounds[2]) * MARGIN
    strip = BAR * width if bars else 0.0
    window = vtkRenderWindow()
    window.SetOffScreenRendering(1)
    window.SetMultiSamples(8)
    window.SetSize(WIDTH, round(WIDTH * (height + strip) / width))
    window.AddRenderer(renderer)
    renderer.SetBackground(1.0, 1.0, 1.0)
    for k, (table, title) in enumerate(bars):
        renderer.AddViewProp(bar_of(table, title, 0.05 + 0.5 * k, strip / (height + strip)))
    camera = renderer.GetActiveCamera()
    camera.ParallelProjectionOn()
    x, y = 0.5 * (bounds[0] + bounds[1]), 0.5 * (bounds[2] + bounds[3] - strip)
    camera.SetFocalPoint(x, y, 0.0)
    camera.SetPosition(x, y, 1.0)
    camera.SetParallelScale(0.5 * (height + strip))
    renderer.ResetCameraClippingRange()
    window.Render()
    image, writer = vtkWindowToImageFilter(), vtkPNGWriter()
    image.SetInput(window)
    image.ReadFrontBufferOff()
    writer.SetInputConnection(image.GetOutputPort())
    writer.SetFileName(str(output))
    output.absolute().parent.mkdir(parents=True, exist_ok=True)
    writer.Write()
    return times


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, help="NAME.vtkhdf")
    parser.add_argument("-o", "--output", type=Path, help="PNG; default NAME.png")
    parser.add_argument("--field", help="of NAME.grid.vtkhdf: pressure, velocity (its length), vorticity; default none")
    parser.add_argument("--colour", default="tension", help='of the membranes: tension, curvature, traction, velocity, vesicle or "none"')
    parser.add_argument("--time", type=float, help="default the last step")
    options = parser.parse_args()
    output = options.output or options.file.with_suffix(".png")
    colour = None if options.colour == "none" else options.colour
    try:
        times = render(options.file, output, options.field, colour, options.time)
    except ImportError as error:
        sys.exit(f"error: {error}: pip install vtk")
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    print(f"{output}: one of {len(times)} steps")


if __name__ == "__main__":
    main()
