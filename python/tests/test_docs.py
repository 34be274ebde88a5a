"""The examples of docs/python.md are correct: its ``python`` blocks run in order, in one session."""

import doctest
import re


def test_the_page(root, monkeypatch):
    monkeypatch.chdir(root)
    page = (root / "docs/python.md").read_text(encoding="utf-8")
    parser, globs, examples = doctest.DocTestParser(), {}, 0
    for block in re.finditer(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL):
        line = page[: block.start()].count("\n") + 1
        test = parser.get_doctest(block[1], globs, "docs/python.md", "docs/python.md", line)
        report = []
        runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.IGNORE_EXCEPTION_DETAIL)
        runner.run(test, out=report.append, clear_globs=False)
        assert not runner.failures, "".join(report)
        globs, examples = test.globs, examples + len(test.examples)
    assert examples > 20


def test_the_first_example_of_the_package():
    import fric

    assert doctest.testmod(fric).failed == 0
