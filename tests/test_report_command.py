"""`surecut report` as a user runs it: formats, several results, other plans, bad input."""

import dataclasses
import io
import json
import re
import shutil
import subprocess
import time

import pytest
from mcap.writer import Writer
from report_results import make_point, make_result, make_rig
from test_report_content import VALIDATED, full_result

from surecut.estimator.cli import main
from surecut.estimator.report.content import build_document
from surecut.estimator.report.pdf import render_pdf
from surecut.estimator.result_json import from_json, to_json
from surecut.estimator.validated_range import range_text
from surecut.factors.rig import dump_rig

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@pytest.fixture
def validation(tmp_path):
    file = tmp_path / "validated.yaml"
    file.write_text(range_text(VALIDATED))
    return str(file)


def stored(folder, result=None, name="result.mcap"):
    """A result as the estimator stores it: an attachment of an MCAP file."""
    path = folder / name
    text = to_json(result or full_result())
    if path.suffix == ".json":
        path.write_text(text, encoding="utf-8")
        return path
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        if result is not False:
            writer.add_attachment(0, 0, "result.json", "application/json", text.encode())
        writer.finish()
    return path


def run(*arguments, capsys=None):
    """Exit status and output of the command line."""
    status = 0
    try:
        main(["report", *map(str, arguments)])
    except SystemExit as stop:
        status = stop.code or 0
    return status, capsys.readouterr() if capsys else None


def test_all_formats_from_a_log_and_from_json(tmp_path, validation, capsys):
    outputs = []
    for name in ("result.mcap", "result.json"):
        source = stored(tmp_path, name=name)
        files = [tmp_path / f"{name}.{kind}" for kind in ("html", "pdf", "report")]
        begun = time.perf_counter()
        status, told = run(
            source, "-o", files[0], "--pdf", files[1], "--json", files[2], "--validation", validation, capsys=capsys
        )
        assert time.perf_counter() - begun < 5
        assert status == 0
        assert told.out.startswith("GO: Cut P1:")
        outputs.append([file.read_bytes() for file in files])
    assert outputs[0] == outputs[1]
    assert all(len(data) < 3_000_000 for data in outputs[0])


def test_without_a_validated_range_no_go(tmp_path, capsys):
    html = tmp_path / "r.html"
    status, told = run(stored(tmp_path), "-o", html, "--validation", tmp_path / "none.yaml", capsys=capsys)
    assert status == 1
    assert "cannot be read" in told.err
    assert not html.exists()


def test_many_results_on_two_processes_and_a_bad_one_is_told(tmp_path, validation, capsys):
    good = [stored(tmp_path, name=f"day{i}.json") for i in range(2)]
    bad = tmp_path / "bad.json"
    bad.write_text("{}")
    options = ("-o", tmp_path / "out", "--json", tmp_path / "out", "--validation", validation, "--jobs", 2)
    status, told = run(*good, bad, *options, capsys=capsys)
    assert status == 1
    assert told.out.count("GO: Cut P1:") == 2
    assert f"{bad}: FAILED: " in told.out
    assert "1 of 3 results gave no report" in told.err
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"day0.html", "day1.html", "day0.json", "day1.json"}


def test_other_cut_plan(tmp_path, validation, capsys):
    rig = tmp_path / "plan.yaml"
    rig.write_text(dump_rig(make_rig(())))
    html = tmp_path / "r.html"
    status, told = run(stored(tmp_path), "-o", html, "--rig", rig, "--validation", validation, capsys=capsys)
    assert status == 0
    assert told.out.startswith("NO VERDICT")
    assert "Cut plan from plan.yaml, not from the rig in the result." in html.read_text(encoding="utf-8")


def test_comparison(tmp_path, validation, capsys):
    other = stored(tmp_path, make_result(points=(make_point(scale=1.5),)), "other.json")
    html, pdf = tmp_path / "r.html", tmp_path / "r.pdf"
    status, _ = run(
        stored(tmp_path), "--compare", other, "-o", html, "--pdf", pdf, "--validation", validation, capsys=capsys
    )
    assert status == 0
    assert "Comparison of two results" in html.read_text(encoding="utf-8")
    assert pdf.read_bytes().startswith(b"%PDF")


def edited(text):
    return text.replace('"measurements":8', '"measurements":80')


def newer(text):
    return text.replace('"format":1', '"format":2')


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (edited, "was changed after it was written"),
        (newer, "update surecut"),
        (lambda _: "{}", "is no surecut result"),
        (lambda _: "", "is no JSON"),
    ],
)
def test_bad_results_get_one_line_and_no_report(tmp_path, spoil, words, capsys):
    source = tmp_path / "result.json"
    good = to_json(full_result())
    source.write_text(spoil(good), encoding="utf-8")
    assert source.read_text(encoding="utf-8") != good
    status, told = run(source, "-o", tmp_path / "r.html", capsys=capsys)
    assert status == 1
    assert words in told.err
    assert told.err.count("\n") == 1
    assert "GO" not in told.out
    assert not (tmp_path / "r.html").exists()


def test_logs_without_a_result_and_wrong_usage(tmp_path, capsys):
    empty = stored(tmp_path, False, "empty.mcap")
    status, told = run(empty, "-o", tmp_path / "r.html", capsys=capsys)
    assert status == 1
    assert told.err.startswith("surecut: ")
    assert told.err.count("\n") == 1
    status, told = run(tmp_path / "none.mcap", "-o", tmp_path / "r.html", capsys=capsys)
    assert status == 1
    assert "cannot be read" in told.err
    status, told = run(stored(tmp_path), capsys=capsys)
    assert status == 2
    assert "nothing to write" in told.err


def test_pdf_says_what_the_page_says():
    pdfium = pytest.importorskip("pypdfium2")
    data = render_pdf(build_document(full_result(), make_rig(), VALIDATED, "c" * 64))
    document = pdfium.PdfDocument(data)
    texts = [page.get_textpage().get_text_range() for page in document]
    assert "GO" in texts[0]
    assert "What to do next" in texts[0]
    assert "Repeat the click" in texts[0]
    assert f"1 of {len(texts)}" in texts[0]
    assert "Can it be believed?" in "".join(texts)
    kinds = [item.type for item in document[0].get_objects()]
    assert kinds.count(pdfium.raw.FPDF_PAGEOBJ_PATH) > 30
    assert document[0].get_size() == pytest.approx((595.3, 841.9), abs=0.1)


def test_pdf_survives_odd_names():
    point = dataclasses.replace(make_point(), id="<b>切</b> & ☃")
    result = make_result(points=(point,), provenance={"x" * 300: "y" * 3000})
    assert render_pdf(build_document(result, make_rig(), None, "")).startswith(b"%PDF")


@pytest.fixture(scope="module")
def browser():
    """Prints a page and gives back the file and every address that was asked for, the browser's own set aside."""
    if BROWSER is None:
        pytest.skip("no Chromium on this machine")

    def opened(page, folder):
        printed, record = folder / "printed.pdf", folder / "net.json"
        quiet = ("--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-first-run")
        options = ("--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder / 'profile'}", *quiet)
        outputs = ("--no-pdf-header-footer", f"--print-to-pdf={printed}", f"--log-net-log={record}")
        subprocess.run([str(BROWSER), *options, *outputs, page.as_uri()], check=True, capture_output=True, timeout=60)
        own = re.compile(
            r"(file|data|chrome[a-z-]*):|https?://([a-z0-9-]+\.)*(google|googleapis|gstatic|gvt1)\.com[/:]"
        )
        return printed, [url for url in addresses(record) if not own.match(url)]

    return opened


def test_in_a_browser(tmp_path, validation, browser):
    """The page as a browser prints it, and the browser's own record of what it asked the network for."""
    pdfium = pytest.importorskip("pypdfium2")
    html = tmp_path / "report.html"
    run(stored(tmp_path), "-o", html, "--validation", validation)
    printed, asked = browser(html, tmp_path)
    assert asked == []
    document = pdfium.PdfDocument(printed)
    first = document[0].get_textpage().get_text_range()
    for words in ("GO", "99.01 %", "As the machine sees it", "Repeat the click"):
        assert words in first
    kinds = [item.type for page in document for item in page.get_objects()]
    assert kinds.count(pdfium.raw.FPDF_PAGEOBJ_IMAGE) == 2
    assert kinds.count(pdfium.raw.FPDF_PAGEOBJ_PATH) > 60


def test_the_browser_would_have_noticed(tmp_path, browser):
    """Control for the test above: a page that does ask for something is caught."""
    page = tmp_path / "page.html"
    page.write_text('<img src="http://surecut.invalid/x.png">')
    assert "http://surecut.invalid/x.png" in browser(page, tmp_path)[1]


def addresses(record):
    """Every address of a request in Chromium's network log."""
    text = record.read_text(encoding="utf-8")
    events = json.loads(text if text.rstrip().endswith("}") else text.rstrip().rstrip(",") + "]}")["events"]
    return [event["params"]["url"] for event in events if "url" in event.get("params", {})]


def test_round_trip_keeps_the_report():
    result = full_result()
    again = from_json(io.BytesIO(to_json(result).encode()).read())
    a = render_pdf(build_document(result, make_rig(), VALIDATED, "c"))
    assert a == render_pdf(build_document(again, make_rig(), VALIDATED, "c"))
