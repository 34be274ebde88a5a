//! Abort codes of SDO transfers and their meanings.

use std::fmt;

/// An abort code of CiA 301, table 22.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Abort(pub u32);

/// Code, name in this file, meaning.
macro_rules! codes {
    ($($name:ident = $code:literal, $text:literal;)*) => {
        impl Abort {
            $(#[doc = $text] pub const $name: Abort = Abort($code);)*

            /// All codes of the standard.
            pub const ALL: &[Abort] = &[$(Abort::$name),*];

            /// The meaning according to the standard; none for a manufacturer-specific code.
            pub fn meaning(self) -> Option<&'static str> {
                match self.0 {
                    $($code => Some($text),)*
                    _ => None,
                }
            }
        }
    };
}

codes! {
    TOGGLE = 0x0503_0000, "toggle bit not alternated";
    TIMED_OUT = 0x0504_0000, "SDO protocol timed out";
    COMMAND = 0x0504_0001, "client or server command specifier not valid or unknown";
    BLOCK_SIZE = 0x0504_0002, "invalid block size";
    SEQUENCE = 0x0504_0003, "invalid sequence number";
    CRC = 0x0504_0004, "CRC error";
    MEMORY = 0x0504_0005, "out of memory";
    ACCESS = 0x0601_0000, "unsupported access to an object";
    WRITE_ONLY = 0x0601_0001, "attempt to read a write only object";
    READ_ONLY = 0x0601_0002, "attempt to write a read only object";
    NO_OBJECT = 0x0602_0000, "object does not exist in the object dictionary";
    NOT_MAPPABLE = 0x0604_0041, "object cannot be mapped to the PDO";
    MAP_LENGTH = 0x0604_0042, "the objects to be mapped would exceed the length of the PDO";
    INCOMPATIBLE = 0x0604_0043, "general parameter incompatibility";
    INTERNAL = 0x0604_0047, "general internal incompatibility in the device";
    HARDWARE = 0x0606_0000, "access failed due to a hardware error";
    LENGTH = 0x0607_0010, "data type does not match, length of service parameter does not match";
    TOO_LONG = 0x0607_0012, "data type does not match, length of service parameter too high";
    TOO_SHORT = 0x0607_0013, "data type does not match, length of service parameter too low";
    NO_SUB = 0x0609_0011, "sub-index does not exist";
    VALUE = 0x0609_0030, "invalid value for parameter";
    TOO_HIGH = 0x0609_0031, "value of parameter written too high";
    TOO_LOW = 0x0609_0032, "value of parameter written too low";
    RANGE = 0x0609_0036, "maximum value is less than minimum value";
    RESOURCE = 0x060A_0023, "resource not available: SDO connection";
    GENERAL = 0x0800_0000, "general error";
    STORE = 0x0800_0020, "data cannot be transferred or stored to the application";
    LOCAL = 0x0800_0021, "data cannot be transferred or stored because of local control";
    STATE = 0x0800_0022, "data cannot be transferred or stored because of the present device state";
    NO_DICTIONARY = 0x0800_0023, "object dictionary dynamic generation fails or no object dictionary is present";
    NO_DATA = 0x0800_0024, "no data available";
}

impl fmt::Display for Abort {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self.meaning() {
            Some(text) => write!(f, "{text} (abort code 0x{:08X})", self.0),
            None => write!(f, "abort code 0x{:08X} of the maker", self.0),
        }
    }
}
