//! The files of the page: what lies in `panel/page/` is what a browser gets.

/// A file of the page.
pub struct File {
    /// Its path in a request.
    pub path: &'static str,
    /// Its media type.
    pub media: &'static str,
    /// Its content.
    pub bytes: &'static [u8],
}

macro_rules! files {
    ($($name:literal: $media:literal),* $(,)?) => {
        &[$(File { path: concat!("/", $name), media: $media, bytes: include_bytes!(concat!("../page/", $name)) }),*]
    };
}

/// Every file. `/` is `/page.html`.
pub const FILES: &[File] = files![
    "page.html": "text/html; charset=utf-8",
    "style.css": "text/css; charset=utf-8",
    "words.js": "text/javascript; charset=utf-8",
    "link.js": "text/javascript; charset=utf-8",
    "plot.js": "text/javascript; charset=utf-8",
    "knobs.js": "text/javascript; charset=utf-8",
    "main.js": "text/javascript; charset=utf-8",
];

/// The file of a path.
pub fn file(path: &str) -> Option<&'static File> {
    let path = if path == "/" { "/page.html" } else { path };
    FILES.iter().find(|file| file.path == path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_list_is_the_folder_and_the_page_is_small() {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/page");
        let mut there: Vec<String> = std::fs::read_dir(folder)
            .unwrap()
            .map(|entry| format!("/{}", entry.unwrap().file_name().to_string_lossy()))
            .collect();
        there.sort();
        let mut listed: Vec<&str> = FILES.iter().map(|file| file.path).collect();
        listed.sort_unstable();
        assert_eq!(listed, there);
        let size: usize = FILES.iter().map(|file| file.bytes.len()).sum();
        assert!(size <= 100_000, "{size} bytes");
        assert!(file("/").is_some_and(|file| file.path == "/page.html") && file("/../Cargo.toml").is_none());
    }

    #[test]
    fn the_page_names_no_other_place() {
        for file in FILES {
            let text = std::str::from_utf8(file.bytes).unwrap();
            for word in
                ["http://", "https://", "innerHTML", "outerHTML", "insertAdjacentHTML", "document.write", "eval("]
            {
                assert!(!text.contains(word), "{} has {word}", file.path);
            }
        }
    }
}
