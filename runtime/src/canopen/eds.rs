//! Electronic data sheets: the objects of a device (EDS) or their configured values (DCF).
//!
//! In: the text. Out: an [`ObjectDictionary`], or the lines with errors. Source: CiA 306-1. Objects are read with type,
//! access, default, limits and mapping; compact sub-objects, comments and file information are ignored.

use super::object::Entry;
use super::{Access, Object, ObjectDictionary, Type};
use std::fmt;

/// An error in a data sheet.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Mistake {
    /// Line, from 1.
    pub line: usize,
    /// The message.
    pub text: String,
}

impl fmt::Display for Mistake {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "line {}: {}", self.line, self.text)
    }
}

/// One section, each value with its line.
struct Section<'t> {
    line: usize,
    name: &'t str,
    values: Vec<(usize, &'t str, &'t str)>,
}

impl<'t> Section<'t> {
    fn get(&self, key: &str) -> Option<(usize, &'t str)> {
        let found = self.values.iter().find(|(_, name, value)| name.eq_ignore_ascii_case(key) && !value.is_empty());
        found.map(|(line, _, value)| (*line, *value))
    }
}

/// Parses a data sheet for a device with the node id `node`, which replaces `$NODEID`.
pub fn read(text: &str, node: u8) -> Result<ObjectDictionary, Vec<Mistake>> {
    let mut mistakes = Vec::new();
    let mut objects = ObjectDictionary::new();
    for section in sections(text, &mut mistakes) {
        let Some(object) = object(section.name) else { continue };
        match entry(object, &section, node) {
            Ok(Some(entry)) => objects.add(entry),
            Ok(None) => {}
            Err(mistake) => mistakes.push(mistake),
        }
    }
    if mistakes.is_empty() && objects.entries().is_empty() {
        mistakes.push(Mistake { line: 1, text: "no object is described: is this a data sheet?".to_string() });
    }
    if mistakes.is_empty() { Ok(objects) } else { Err(mistakes) }
}

fn sections<'t>(text: &'t str, mistakes: &mut Vec<Mistake>) -> Vec<Section<'t>> {
    let mut sections: Vec<Section> = Vec::new();
    for (at, line) in text.trim_start_matches('\u{FEFF}').lines().enumerate() {
        let (at, line) = (at + 1, line.trim());
        if line.is_empty() || line.starts_with([';', '#']) {
            continue;
        }
        if let Some(name) = line.strip_prefix('[') {
            match name.strip_suffix(']') {
                Some(name) => sections.push(Section { line: at, name: name.trim(), values: Vec::new() }),
                None => mistakes.push(Mistake { line: at, text: format!("`{line}` lacks its `]`") }),
            }
        } else if let Some((key, value)) = line.split_once('=') {
            // Lines before the first section are ignored.
            if let Some(section) = sections.last_mut() {
                section.values.push((at, key.trim(), value.trim()));
            }
        } else {
            mistakes.push(Mistake { line: at, text: format!("`{line}` is neither `[section]` nor `key = value`") });
        }
    }
    sections
}

/// The object of a section's name: `6040`, `1018sub1`.
fn object(name: &str) -> Option<Object> {
    let name = name.to_ascii_lowercase();
    let (index, sub) = name.split_once("sub").unwrap_or((&name, "0"));
    if index.len() != 4 {
        return None;
    }
    Some(Object(u16::from_str_radix(index, 16).ok()?, u8::from_str_radix(sub, 16).ok()?))
}

/// The entry that a section describes; none if it only announces sub-objects.
fn entry(object: Object, section: &Section, node: u8) -> Result<Option<Entry>, Mistake> {
    let mistake = |line: usize, text: String| Mistake { line, text };
    let number_of = |key: &str, kind: Type| match section.get(key) {
        None => Ok(None),
        Some((line, text)) => number(text, node, kind)
            .map(Some)
            .ok_or_else(|| mistake(line, format!("`{text}` is no number for {key} of object {object}"))),
    };
    // 7: variable. 8 and 9, arrays and records, only contain the number of their sub-objects.
    if number_of("ObjectType", Type::I64)?.unwrap_or(7) != 7 {
        return Ok(None);
    }
    let name = section.get("ParameterName").map_or("", |(_, name)| name);
    let Some(code) = number_of("DataType", Type::I64)? else {
        return Err(mistake(section.line, format!("object {object} has no DataType")));
    };
    let kind = match code {
        0x1 => Type::Boolean,
        0x2 => Type::I8,
        0x3 => Type::I16,
        0x4 => Type::I32,
        0x5 => Type::U8,
        0x6 => Type::U16,
        0x7 => Type::U32,
        0x8 => Type::F32,
        0x9 | 0xA | 0xB | 0xF => Type::Bytes,
        0x11 => Type::F64,
        0x15 => Type::I64,
        0x1B => Type::U64,
        // Times, 24- and 40-bit integers: no drive needs them in its cycle.
        _ => return Ok(None),
    };
    let access = match section.get("AccessType") {
        None => return Err(mistake(section.line, format!("object {object} has no AccessType"))),
        Some((line, text)) => match text.to_ascii_lowercase().as_str() {
            "const" => Access::Constant,
            "ro" => Access::ReadOnly,
            "wo" => Access::WriteOnly,
            "rw" | "rwr" | "rww" => Access::ReadWrite,
            _ => return Err(mistake(line, format!("access `{text}` is none of ro, wo, rw, rwr, rww, const"))),
        },
    };
    if kind == Type::Bytes {
        let value = section.get("ParameterValue").or(section.get("DefaultValue")).map_or("", |(_, text)| text);
        return Ok(Some(Entry::text(object, name, access, value, super::sdo::LONGEST)));
    }
    let value = match number_of("ParameterValue", kind)? {
        Some(value) => value,
        None => number_of("DefaultValue", kind)?.unwrap_or(0),
    };
    let mut entry = Entry::number(object, name, kind, access, value);
    if !matches!(kind, Type::F32 | Type::F64) {
        entry.range.0 = number_of("LowLimit", kind)?.unwrap_or(i64::MIN);
        entry.range.1 = number_of("HighLimit", kind)?.unwrap_or(i64::MAX);
    }
    entry.mappable = number_of("PDOMapping", Type::I64)? == Some(1);
    Ok(Some(entry))
}

/// `12`, `0x1F`, `-3`, `$NODEID+0x180`, `0x180+$NODEID`, `1.5`. A hexadecimal number is the bit pattern of its type.
fn number(text: &str, node: u8, kind: Type) -> Option<i64> {
    let upper = text.to_ascii_uppercase();
    if upper.contains("$NODEID") {
        let rest = upper.replacen("$NODEID", "", 1);
        let rest = rest.trim().trim_matches('+').trim();
        let base = if rest.is_empty() { 0 } else { number(rest, node, Type::I64)? };
        return base.checked_add(node.into());
    }
    if let Some(digits) = upper.strip_prefix("0X") {
        let bits = u64::from_str_radix(digits, 16).ok()?;
        let size = kind.size().unwrap_or(8);
        return Some(kind.number(&bits.to_le_bytes()[..size]));
    }
    match kind {
        Type::F32 => upper.parse().ok().map(|value: f32| value.to_bits().into()),
        Type::F64 => upper.parse().ok().map(|value: f64| value.to_bits() as i64),
        _ => upper.parse().ok(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHEET: &str = "\
[FileInfo]
FileName=drive.eds
[1000]
ParameterName=Device type
ObjectType=0x7
DataType=0x0007
AccessType=ro
DefaultValue=0x00020192
PDOMapping=0
; identity
[1018]
ParameterName=Identity
ObjectType=0x9
SubNumber=2
[1018sub1]
ParameterName=Vendor
DataType=0x0007
AccessType=const
DefaultValue=0x1AF
[1400sub1]
ParameterName=COB-ID
ObjectType=7
DataType=7
AccessType=rw
DefaultValue=$NODEID+0x200
[6071]
ParameterName=Target torque
ObjectType=0x7
DataType=0x0003
AccessType=rww
LowLimit=0xFC18
HighLimit=1000
DefaultValue=
PDOMapping=1
[1008]
ParameterName=Name
DataType=0x9
AccessType=const
DefaultValue=Servo 400
";

    #[test]
    fn objects_are_read_with_all_their_attributes() {
        let mut objects = read(SHEET, 5).expect("the sheet is right");
        assert_eq!(objects.get(Object(0x1000, 0)), Some(0x20192));
        assert_eq!(objects.get(Object(0x1018, 1)), Some(0x1AF));
        assert!(objects.entry(Object(0x1018, 0)).is_none());
        assert_eq!(objects.get(Object(0x1400, 1)), Some(0x205));
        assert_eq!(objects.read(Object(0x1008, 0)), Ok(&b"Servo 400"[..]));
        let torque = objects.entry(Object(0x6071, 0)).expect("described");
        assert_eq!((torque.range, torque.mappable, torque.kind), ((-1000, 1000), true, Type::I16));
        let refused = objects.write(Object(0x6071, 0), &1001i16.to_le_bytes());
        assert_eq!(refused, Err(super::super::Abort::TOO_HIGH));
    }

    #[test]
    fn a_configured_value_takes_precedence_over_a_default() {
        let text = "[6072]\nParameterName=Max\nDataType=6\nAccessType=rw\nDefaultValue=3000\nParameterValue=1500\n";
        assert_eq!(read(text, 1).unwrap().get(Object(0x6072, 0)), Some(1500));
    }

    #[test]
    fn mistakes_name_their_line() {
        let told = |text: &str| {
            let mistakes = read(text, 1).expect_err("a mistake");
            mistakes.iter().map(Mistake::to_string).collect::<Vec<_>>()
        };
        assert_eq!(told("[6040\n"), ["line 1: `[6040` lacks its `]`"]);
        assert_eq!(told("[6040]\nhello\n")[0], "line 2: `hello` is neither `[section]` nor `key = value`");
        assert_eq!(told("[6040]\nAccessType=rw\n"), ["line 1: object 6040:00 has no DataType"]);
        assert_eq!(told("[6040]\nDataType=6\n"), ["line 1: object 6040:00 has no AccessType"]);
        assert_eq!(
            told("[6040]\nDataType=6\nAccessType=any\n"),
            ["line 3: access `any` is none of ro, wo, rw, rwr, rww, const"]
        );
        assert_eq!(
            told("[6040]\nDataType=6\nAccessType=rw\nDefaultValue=much\n"),
            ["line 4: `much` is no number for DefaultValue of object 6040:00"]
        );
        assert_eq!(told(""), ["line 1: no object is described: is this a data sheet?"]);
    }
}
