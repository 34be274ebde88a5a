//! The plan of a sweep as a file: all that determines its table, so that any machine can compute any of its runs.
//!
//! In: a request, its text and the files that the text names. Out: a file of JSON, and the same sweep read from it. The
//! library goes by its hash. Reading a plan opens no other file.

use super::request::Request;
use super::version::Unusable;
use crate::args::Keep;
use crate::compile::{self, Loaded, Method};
use crate::named_files::{NamedFile, NamedFiles};
use crate::unfinished::Hash;
use crate::{project, vary};
use serde_json::{Value, json};

/// The layout of the file. Raised also when a change gives the rows of a sweep other bits.
const FORMAT: u64 = 2;

/// A sweep that can be sent elsewhere.
pub struct Plan {
    pub request: Request,
    pub text: SentText,
    /// The SHA-256 of its file, in hexadecimal.
    pub hash: String,
}

/// A text with the files that it names.
pub struct SentText {
    name: String,
    text: String,
    files: Vec<NamedFile>,
}

/// Hash of all texts of the library.
fn library() -> String {
    let all = project::library().iter();
    let hash = all.fold(Hash::EMPTY, |hash, (name, text)| hash.and(name.as_bytes()).and(&[0]).and(text.as_bytes()));
    format!("{hash:016x}")
}

/// A plan as the bytes of its file.
pub fn bytes(request: &Request, name: &str, text: &str, files: &[NamedFile]) -> Vec<u8> {
    // A number as the shortest text that reads back as the same bits.
    let number = |x: Option<f64>| x.map(|x| format!("{x:?}"));
    let object = json!({
        "fric sweep": FORMAT,
        "version": env!("CARGO_PKG_VERSION"),
        "library": library(),
        "experiment": request.experiment,
        "design": request.design,
        "vary": request.vary.iter().map(|vary| &vary.text).collect::<Vec<_>>(),
        "set": request.set,
        "solver": request.method.map(Method::name),
        "step": number(request.step),
        "tol": number(request.tol),
        "duration": number(request.duration),
        "best": request.best,
        "keep": request.keep.name(),
        "runs": request.runs,
        "seed": request.seed,
        "name": name,
        "text": text,
        "files": files,
    });
    let mut bytes = serde_json::to_vec_pretty(&object).expect("texts and numbers are JSON");
    bytes.push(b'\n');
    bytes
}

/// Reads a plan.
///
/// # Errors
/// What is wrong with it.
pub fn read(bytes: &[u8]) -> Result<Plan, Unusable> {
    let object: Value = serde_json::from_slice(bytes).map_err(|_| Unusable::NotWhole)?;
    let told = |key: &str| object[key].as_str().unwrap_or("?").to_string();
    let format = object["fric sweep"].as_u64().ok_or(Unusable::NotWhole)?;
    if format != FORMAT || told("version") != env!("CARGO_PKG_VERSION") {
        return Err(Unusable::Version(told("version"), format, FORMAT));
    }
    if told("library") != library() {
        return Err(Unusable::Library);
    }
    let text = |key: &str| object[key].as_str().map(str::to_string);
    let texts = |value: &Value| -> Option<Vec<String>> {
        value.as_array()?.iter().map(|one| one.as_str().map(str::to_string)).collect()
    };
    let number = |key: &str| match &object[key] {
        Value::Null => Some(None),
        value => value.as_str()?.parse::<f64>().ok().map(Some),
    };
    let whole = |key: &str| match &object[key] {
        Value::Null => Some(None),
        value => value.as_u64().map(Some),
    };
    let method = || match &object["solver"] {
        Value::Null => Some(None),
        value => Method::ALL.into_iter().find(|method| value.as_str() == Some(method.name())).map(Some),
    };
    let plan = || {
        let files = object["files"].as_array()?.iter().map(|file| {
            let [from, path, name, text]: [String; 4] = texts(file)?.try_into().ok()?;
            Some((from, path, name, text))
        });
        let vary = texts(&object["vary"])?;
        Some(Plan {
            request: Request {
                experiment: text("experiment")?,
                vary: vary.iter().map(|text| vary::parse(text).ok()).collect::<Option<_>>()?,
                design: match &object["design"] {
                    Value::Null if object.get("design").is_some() => None,
                    value => Some(value.as_str()?.to_string()),
                },
                set: texts(&object["set"])?,
                method: method()?,
                step: number("step")?,
                tol: number("tol")?,
                duration: number("duration")?,
                best: texts(&object["best"])?,
                runs: whole("runs")?,
                seed: whole("seed")?,
                keep: Keep::ALL.into_iter().find(|keep| object["keep"].as_str() == Some(keep.name()))?,
                interpret: false,
            },
            text: SentText { name: text("name")?, text: text("text")?, files: files.collect::<Option<_>>()? },
            hash: runtime::package::hash(bytes),
        })
    };
    plan().ok_or(Unusable::NotWhole)
}

impl SentText {
    /// Loads it; the disk is not read.
    pub fn load(&self) -> (Loaded, NamedFiles) {
        let sources = NamedFiles::closed(self.files.clone());
        (compile::load(&self.name, &self.text, &sources), sources)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plan_is_read_as_it_was_written_and_refused_if_anything_is_missing() {
        let request = Request {
            experiment: "e".into(),
            vary: vec![vary::parse("fr.Fs = 1 N .. 2 N by 0.1 N").unwrap(), vary::parse("m ~ ±20 %").unwrap()],
            set: vec!["fr=Dahl(sigma = 1e5 N/m)".into()],
            method: Some(Method::Expo),
            step: Some(0.1 + 0.2),
            duration: Some(1e-300),
            runs: Some(u64::MAX),
            best: vec!["5 by rms(x)".into()],
            keep: Keep::Summary,
            design: Some("m [kg]\n1\n".into()),
            ..Request::default()
        };
        let files = [("a".to_string(), "b.csv".to_string(), "/c/b.csv".to_string(), "t;x\n\"é\n".to_string())];
        let written = bytes(&request, "a.fric", "model \"é\"\n", &files);
        let plan = read(&written).unwrap();
        assert_eq!(format!("{:?}", plan.request), format!("{request:?}"));
        let SentText { name, text, files: found } = &plan.text;
        assert_eq!((name.as_str(), text.as_str(), &found[..]), ("a.fric", "model \"é\"\n", &files[..]));
        assert_eq!(bytes(&plan.request, name, text, found), written);
        for end in 0..written.len() - 1 {
            let why = read(&written[..end]).err().unwrap_or_else(|| panic!("cut to {end} bytes it was read"));
            assert_eq!(why, Unusable::NotWhole);
            assert!(why.to_string().contains("no whole plan"), "{why}");
        }
        let text = String::from_utf8(written).unwrap();
        let keys = ["keep", "design", "experiment", "vary", "set", "best", "name", "text", "files"];
        for key in keys {
            assert!(read(text.replace(&format!("\"{key}\":"), "\"other\":").as_bytes()).is_err(), "{key}");
        }
        let newer = text.replace("\"fric sweep\": 2", "\"fric sweep\": 3");
        assert!(read(newer.as_bytes()).err().unwrap().to_string().contains("kind 3"));
        let other = text.replace(&library(), "0123456789abcdef");
        assert!(read(other.as_bytes()).err().unwrap().to_string().contains("another library"));
    }
}
