//! A report: the page with what it shows, in one file that needs nothing else.

use crate::page::FILES;
use serde_json::Value;

/// One HTML file with the page and its data. `hello` and `state` are those of a subject; `curves` holds for each curve
/// its number and its points.
///
/// The scripts become one: the lines of `import` go, and so does the word `export`. They have no name twice at the top.
pub fn report(title: &str, hello: &Value, state: &Value, curves: &[(u32, Vec<(f64, f64)>)]) -> String {
    let text = |path: &str| {
        let file = FILES.iter().find(|file| file.path == path).unwrap_or_else(|| panic!("the page has {path}"));
        std::str::from_utf8(file.bytes).expect("the files of the page are text")
    };
    let mut script = String::new();
    for file in FILES.iter().filter(|file| file.media.starts_with("text/javascript")) {
        for line in text(file.path).lines().filter(|line| !line.starts_with("import ")) {
            script += line.strip_prefix("export ").unwrap_or(line);
            script.push('\n');
        }
    }
    let number = |x: f64| if x.is_finite() { format!("{}", x as f32) } else { "null".into() };
    let curves: Vec<String> = curves
        .iter()
        .map(|(curve, points)| {
            let x: Vec<String> = points.iter().map(|point| format!("{}", point.0)).collect();
            let y: Vec<String> = points.iter().map(|point| number(point.1)).collect();
            format!("{{\"curve\":{curve},\"x\":[{}],\"y\":[{}]}}", x.join(","), y.join(","))
        })
        .collect();
    let data = format!("{{\"hello\":{hello},\"state\":{state},\"curves\":[{}]}}", curves.join(","));
    let policy = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:";
    text("/page.html")
        .replace("<title>fric</title>", &format!("<title>{}</title>", escaped(title)))
        .replace("<meta charset=\"utf-8\">", &format!("<meta charset=\"utf-8\"><meta http-equiv=\"Content-Security-Policy\" content=\"{policy}\">"))
        .replace("<link rel=\"stylesheet\" href=\"style.css\">", &format!("<style>\n{}</style>", text("/style.css")))
        .replace(
            "<script type=\"module\" src=\"main.js\"></script>",
            &format!(
                "<script type=\"application/json\" id=\"data\">{}</script>\n<script type=\"module\">\n{script}</script>",
                // In a script element only `<` could end it or begin another one.
                data.replace('<', "\\u003c")
            ),
        )
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn a_report_holds_everything_and_no_text_of_the_data_becomes_markup() {
        let hello = json!({ "title": "</script><img src=x onerror=alert(1)>" });
        let html = report("a <b>", &hello, &json!({}), &[(3, vec![(0.0, 1.5), (1.0, f64::NAN)])]);
        assert!(html.contains("<title>a &lt;b&gt;</title>") && html.contains("\"y\":[1.5,null]"));
        assert!(!html.contains("<img") && html.contains("\\u003c/script>\\u003cimg"));
        for left in ["src=\"main.js\"", "href=\"style.css\"", "\nimport ", "\nexport "] {
            assert!(!html.contains(left), "{left}");
        }
        assert!(html.contains("Content-Security-Policy"));
    }
}
