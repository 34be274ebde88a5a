//! Texts that other tests read.

/// Number and text of each.
pub const SAMPLES: [(&str, &str); 11] = [
    ("00", include_str!("../data/00_interfaces.fric")),
    ("01", include_str!("../data/01_tustin.fric")),
    ("02", include_str!("../data/02_kfm.fric")),
    ("03", include_str!("../data/03_karnopp.fric")),
    ("04", include_str!("../data/04_bliman_sorine.fric")),
    ("05", include_str!("../data/05_lugre.fric")),
    ("06", include_str!("../data/06_lugre_observer.fric")),
    ("07", include_str!("../data/07_pid.fric")),
    ("08", include_str!("../data/08_servo_sil.fric")),
    ("09", include_str!("../data/09_rig_hil.fric")),
    ("10", include_str!("../data/10_gms.fric")),
];
