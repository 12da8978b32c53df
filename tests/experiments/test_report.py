import html.parser
import json
import os
import re
import shutil
import struct
import subprocess
import zlib
from pathlib import Path

import pytest

from experiments import report, report_charts, report_tables
from seal_gym.core.errors import SealGymError

RESULTS = Path(__file__).resolve().parents[2] / "experiments" / "results"
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


def control_row(method="rmp_expert", part="flat", rmse=0.0494606, training_seed=None):
    return {
        "method": method,
        "workpiece": part,
        "trials": 100,
        "seed0": 1_000_000,
        "training_seed": training_seed,
        "reached_pct": 97.0,
        "reached_ci": [91.5, 99.0],
        "collision_pct": 2.0,
        "collision_ci": [0.6, 7.0],
        "timeout_pct": 1.0,
        "timeout_ci": [0.2, 5.4],
        "rmse_mm": rmse,
        "rmse_mm_ci": None if rmse is None else [0.9 * rmse, 1.2 * rmse],
        "coverage_pct": 99.03,
        "time_s": 30.09,
        "time_s_ci": [30.07, 30.1],
    }


def document(name="table4", rows=None, **more):
    return {
        "name": name,
        "version": "0.1.0",
        "command": f"python -m experiments.{name} --trials 100 --seed 1000000 --out '<out>'",
        "git_commit": "0123456789abcdef",
        "stack": {"mujoco": "4.0.0"},
        "renderer": "raycast",
        "regime": "dynamic",
        "rows": [control_row()] if rows is None else rows,
        "trials": [{"seed": 1_000_000}, {"seed": 1_000_099}],
    } | more


def png(path, width=7, height=5):
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = b"".join(b"\0" + b"\x80" * width for _ in range(height))
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )


@pytest.fixture
def folder(tmp_path):
    made = tmp_path / "results"
    (made / "oracle").mkdir(parents=True)
    (made / "table4.json").write_text(json.dumps(document()))
    (made / "table4.csv").write_text("method\n")
    (made / "oracle" / "demo.json").write_text(json.dumps(document("demo", renderer="none")))
    (made / "not_a_result.json").write_text("[1, 2]")
    (made / "bench.txt").write_text("3 < 5 us")
    png(made / "table4_frames.png")
    png(made / "oracle" / "flat.png")
    (made / "table4.mp4").write_bytes(b"film")
    return made


class Reader(html.parser.HTMLParser):
    """Tags with their attributes, nesting, and the text of each table cell."""

    VOID = ("meta", "link", "img", "br")

    def __init__(self, text):
        super().__init__()
        self.tags, self.open, self.rows = [], [], []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag  # properly nested, every element closed

    def handle_data(self, data):
        if {"td", "th"} & set(self.open):
            self.rows[-1][-1] += f" {data.strip()}" if data.strip() else ""

    def all(self, tag):
        return [attrs for name, attrs in self.tags if name == tag]


@pytest.fixture
def site(folder, tmp_path):
    out = tmp_path / "site"
    assert report.main(["--results", str(folder), "--out", str(out)]) == 0
    return out


@pytest.fixture
def page(site):
    return Reader((site / "index.html").read_text(encoding="utf-8"))


def test_a_row_shows_the_jsons_numbers_and_intervals(page):
    row = next(r for r in page.rows if r[:2] == [" flat", " rmp_expert"])
    shown = "flat rmp_expert 100 97.0 [91.5, 99.0] 2.0 [0.6, 7.0] 1.0 [0.2, 5.4] 0.0495 [0.0445, 0.0594]"
    assert " ".join(" ".join(row).split()) == f"{shown} 99.0 30.09 [30.07, 30.10]"
    assert "0.0494606" in [d["value"] for d in page.all("data")]


def test_what_made_a_number_stands_beside_it_and_is_escaped(site):
    text = (site / "index.html").read_text(encoding="utf-8")
    for words in (
        "python -m experiments.table4 --trials 100 --seed 1000000 --out &#39;&lt;out&gt;&#39;",
        "0123456789abcdef",
        "1000000 to 1000099",
        "dynamic",
        "<dt>mujoco</dt><dd>4.0.0</dd>",
        "3 &lt; 5 us",
    ):
        assert words in text


def test_the_page_needs_nothing_but_the_files_beside_it(site, page):
    wanted = [a[k] for _, a in page.tags for k in ("src", "href") if k in a]
    beside = [w for w in wanted if not w.startswith(("#", "data:"))]
    assert {"data/table4.json", "media/table4_frames.png", "media/table4.mp4"} <= set(beside)
    assert all((site / w).is_file() for w in beside)
    assert not page.all("script")
    style = (site / "index.html").read_text(encoding="utf-8").split("<style>")[1].split("</style>")[0]
    assert "url(" not in style and "@import" not in style


def test_links_within_the_page_have_targets_and_ids_are_single(page):
    ids = [a["id"] for _, a in page.tags if "id" in a]
    assert len(ids) == len(set(ids))
    named = [a["aria-labelledby"] for _, a in page.tags if "aria-labelledby" in a]
    links = [a["href"][1:] for a in page.all("a") if a["href"].startswith("#")]
    assert set(named + links) <= set(ids)
    assert len(page.all("caption")) == len(page.all("table")) > 0
    assert all(a.get("scope") in ("row", "col") for a in page.all("th"))
    assert all(a["alt"] and (a["width"], a["height"]) == ("7", "5") for a in page.all("img"))
    assert page.open == []


def test_files_go_to_the_result_they_belong_to(folder):
    found = report.read(folder)
    assert [p.as_posix() for p in found] == ["table4.json", "oracle/demo.json"]
    assert report.owner(Path("table4_frames.png"), found) == Path("table4.json")
    assert report.owner(Path("oracle/flat.png"), found) == Path("oracle/demo.json")
    assert report.owner(Path("oracle/other.png"), found) is None


def test_a_folder_without_results_is_refused(tmp_path, capsys):
    with pytest.raises(SealGymError, match="no such folder"):
        report.read(tmp_path / "none")
    assert report.main(["--results", str(tmp_path), "--out", str(tmp_path / "site")]) == 2
    assert "no result in it" in capsys.readouterr().err
    assert not (tmp_path / "site" / "index.html").exists()


def test_a_picture_that_is_none_is_refused(folder, tmp_path, capsys):
    (folder / "table4.png").write_text("no picture")
    assert report.main(["--results", str(folder), "--out", str(tmp_path / "site")]) == 2
    assert "table4.png: not a PNG" in capsys.readouterr().err


def test_videos_from_elsewhere_come_along(folder, tmp_path, capsys):
    films = tmp_path / "films"
    films.mkdir()
    (films / "flat_run.webm").write_bytes(b"film")
    out = tmp_path / "site"
    call = ["--results", str(folder), "--out", str(out), "--videos"]
    assert report.main([*call, str(films)]) == 0
    sources = [a["src"] for a in Reader((out / "index.html").read_text(encoding="utf-8")).all("video")]
    assert len(sources) == 2 and all((out / s).read_bytes() == b"film" for s in sources)
    assert report.main([*call, str(tmp_path / "none")]) == 2
    assert "none" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({}, "1000000 to 1000099"),
        ({"trials": [{"seed": 7}]}, "7"),
        ({"trials": [], "seed0": 500_000}, "from 500000 on"),
        ({"trials": []}, "from 1000000 on"),  # of the command
        ({"trials": [], "command": "x"}, "not recorded"),
        (
            {"trials": [], "command": "x", "rows": [control_row(training_seed=s) for s in (2, 0)]},
            "training 0, 2",
        ),
    ],
)
def test_seeds_in_words(more, words):
    assert report.seeds(document(**more)) == words


def test_control_rows_are_told_apart_by_whatever_differs():
    rows = [
        control_row("neural_rmp", "flat", training_seed=0) | {"disturbance": "light", "severity": 0.5},
        control_row("neural_rmp", "flat", training_seed=1) | {"disturbance": "light", "severity": 2.0},
        control_row("adaptive", "cylinder", rmse=None) | {"disturbance": "light", "severity": 2.0},
    ]
    (table,) = report_tables.tables(document(rows=rows))
    heads = [c.key for c in table.columns[: table.heads]]
    assert heads == ["workpiece", "method", "training_seed", "severity"]
    assert [[c.text for c in row[: table.heads]] for row in table.rows] == [
        ["flat", "neural_rmp", "0", "0.5"],
        ["flat", "neural_rmp", "1", "2"],
        ["cylinder", "adaptive", "-", "2"],
    ]
    rmse = [c.key for c in table.columns].index("rmse_mm")
    assert table.rows[2][rmse] == ("-", None, "")


def test_table_2_has_a_row_for_each_method_and_a_column_for_each_feature():
    rows = [
        {
            "workpiece": "flat",
            "view": view,
            "feature": feature,
            "region": "all",
            "edge": edge,
            "refined": False,
        }
        | {"tracker": "none", "kalman": False, "rmse": value, "rmse_ci": [value, value], "unit": "px"}
        | {"availability_pct": 99.0 - value}
        for view, feature, edge, value in (
            ("front", "d_attr", "ours", 0.5),
            ("side", "d_attr", "ours", 0.25),
            ("front", "d_attr", "canny", 1.0),
            ("side", "d_attr", "canny", 2.0),
        )
    ]
    (table,) = report_tables.tables(document("table2", rows))
    assert [[c.text for c in row] for row in table.rows] == [
        ["ours", "raw", "0.50", "0.25", "98.5"],
        ["canny", "raw", "1.00", "2.00", "97.0"],
    ]
    assert [c.label for c in table.columns][2:4] == ["front view, distance px", "side view, distance px"]


def test_other_tables_are_split_and_tell_what_is_constant():
    rows = [
        {
            "table": t,
            "method": m,
            "frames": 200,
            "failed_pct": 1.25,
            "failed_ci": [0.5, 3.0],
            "settings": {"a": 0.5},
        }
        for t in ("run", "photos")
        for m in ("canny", "sobel")
    ]
    extra = [{"camera": "front", "error_px": 0.012345}, {"camera": "side", "error_px": 12345.6}]
    found = report_tables.tables(document("fig12", rows, parts=extra))
    constant = "frames 200; failed % 1.2; settings a 0.5"
    assert [t.caption for t in found] == [
        f"Rows: run ({constant})",
        f"Rows: photos ({constant})",
        "Rows: parts",
    ]
    assert [[c.text for c in row] for row in found[2].rows] == [["front", "0.01235"], ["side", "12346"]]


def test_many_rows_are_split_until_they_can_be_read():
    rows = [{"level": k % 3, "n": k, "x": 0.5 * k} for k in range(450)]
    found = report_tables.tables(document("x", rows))
    assert [len(t.rows) for t in found] == [150, 150, 150]
    assert not any(t.open for t in found)


def test_axes_hold_all_values_between_round_ticks():
    assert report_charts.axis([0.047, 0.0581]) == (
        0.0,
        pytest.approx(0.06),
        False,
        pytest.approx([0, 0.02, 0.04, 0.06]),
    )
    assert report_charts.axis([0.02, 3.0]) == (0.01, 10.0, True, pytest.approx([0.01, 0.1, 1.0, 10.0]))
    assert report_charts.axis([12.0, 100.0], percent=True)[:2] == (0.0, 100.0)
    assert report_charts.axis([96.3, 100.0], percent=True) == (90.0, 100.0, False, [90.0, 95.0, 100.0])
    assert report_charts.axis([0.0]).high > 0


def test_dots_lie_where_their_values_are():
    dots = [
        report_charts.Dot("a", 25.0, (0.0, 100.0), "25.0", 0),
        report_charts.Dot("b", 50.0, None, "50.0", 1),
    ]
    chart = report_charts.dot_plot("t", [report_charts.Group("flat", dots)], "%")
    a, b = chart.marks
    span = chart.right - chart.left
    assert (a.low, a.high) == (chart.left, chart.right)
    assert a.x == pytest.approx(chart.left + 0.25 * span)
    assert b.x == b.low == b.high == pytest.approx(chart.left + 0.5 * span)
    assert a.y < b.y < chart.bottom < chart.height
    assert a.title == "flat, a: 25.0 %, 95 % interval 0 to 100"
    decades = report_charts.axis([0.01, 1.0])
    assert decades.place(0.1) == pytest.approx((decades.place(0.01) + decades.place(1.0)) / 2)


MEASURE = """
<script>
function luminance(rgb) {
  const linear = v => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4;
  const c = rgb.match(/[0-9.]+/g).slice(0, 3).map(v => linear(v / 255));
  return 0.2126 * c[0] + 0.7152 * c[1] + 0.0722 * c[2];
}
function contrast(e, property) {
  let box = e;
  while (getComputedStyle(box).backgroundColor === "rgba(0, 0, 0, 0)") box = box.parentElement;
  const a = luminance(getComputedStyle(e)[property]), b = luminance(getComputedStyle(box).backgroundColor);
  return (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
}
addEventListener("load", () => {
  const table = document.querySelector("#demo-table-1-table");
  const head = [...table.tHead.rows[0].cells].map(c => c.innerText.replace(/\\s+/g, " "));
  const cells = row => Object.fromEntries([...row.cells].map((c, k) => [head[k], c.innerText]));
  const kinds = "p, h1, h2, a, th, td, small, dt, dd, code, summary, figcaption";
  const texts = [...document.querySelectorAll(kinds)];
  const seen = texts.filter(e => e.checkVisibility() && e.innerText.trim() && !e.matches(".skip"));
  const drawn = [...document.querySelectorAll("svg text")].filter(e => e.checkVisibility());
  const boxes = drawn.map(e => [e.getBoundingClientRect(), e.ownerSVGElement.getBoundingClientRect()]);
  parent.postMessage({
    cells: [...table.tBodies[0].rows].map(cells),
    width: document.documentElement.scrollWidth, screen: innerWidth,
    least: Math.min(...seen.map(e => contrast(e, "color")), ...drawn.map(e => contrast(e, "fill"))),
    smallest: Math.min(...boxes.map(([b]) => b.height)),
    outside: boxes.filter(([b, s]) => b.left < s.left - 1 || b.right > s.right + 1).length,
    dark: luminance(getComputedStyle(document.body).backgroundColor) < 0.2,
    broken: [...document.images].filter(i => i.checkVisibility() && i.complete && !i.naturalWidth).length,
    marks: document.querySelectorAll("svg .dot").length,
  }, "*");
});
</script>
"""
FRAME = """<!DOCTYPE html>
<iframe src="measured.html" width="{width}" height="800"></iframe>
<pre id="out"></pre>
<script>
const out = document.querySelector("#out");
addEventListener("message", message => out.textContent = JSON.stringify(message.data));
</script>
"""


@pytest.fixture(scope="module")
def real_site(tmp_path_factory):
    out = tmp_path_factory.mktemp("site")
    assert report.main(["--results", str(RESULTS), "--out", str(out)]) == 0
    text = (out / "index.html").read_text(encoding="utf-8")
    (out / "measured.html").write_text(text.replace("</body>", f"{MEASURE}</body>"), encoding="utf-8")
    return out


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: apt-get install chromium")
@pytest.mark.parametrize(("width", "dark"), [(360, True), (1280, False)])
def test_a_browser_shows_the_jsons_numbers_on_a_phone_and_in_the_dark(real_site, tmp_path, width, dark):
    frame = real_site / f"frame{width}.html"
    frame.write_text(FRAME.format(width=width), encoding="utf-8")
    command = [
        CHROMIUM, "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage",
        "--allow-file-access-from-files", f"--user-data-dir={tmp_path}", "--no-first-run",
        "--disable-background-networking", "--virtual-time-budget=20000", "--window-size=1400,900",
        f"--blink-settings=preferredColorScheme={0 if dark else 1}", "--dump-dom", frame.as_uri(),
    ]  # fmt: skip
    env = {k: v for k, v in os.environ.items() if not k.startswith("DBUS")}
    run = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, env=env)
    assert run.returncode == 0, run.stderr
    found = re.search(r'<pre id="out">(\{.*\})</pre>', run.stdout, re.DOTALL)
    assert found is not None, run.stderr[-2000:]
    seen = json.loads(html.unescape(found[1]))

    rows = json.loads((RESULTS / "demo.json").read_text())["rows"]
    assert len(seen["cells"]) == len(rows)
    for cells, row in zip(seen["cells"], rows, strict=True):
        assert cells["part"] == row["workpiece"]
        number, low, high = re.findall(r"[0-9.]+", cells["RMSE mm"])
        assert abs(float(number) - row["rmse_mm"]) <= 0.5e-4
        assert abs(float(low) - row["rmse_mm_ci"][0]) <= 0.5e-4
        assert abs(float(high) - row["rmse_mm_ci"][1]) <= 0.5e-4
    assert seen["marks"] >= len(rows)
    assert seen["dark"] is dark
    assert seen["width"] <= seen["screen"] == width, "the page scrolls sideways"
    assert seen["least"] >= 4.5, "WCAG AA"
    assert seen["smallest"] >= 10, "text in the charts [px]"
    assert seen["outside"] == 0, "text in the charts is cut off"
    assert seen["broken"] == 0
