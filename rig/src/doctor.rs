//! Checks whether this computer meets real-time requirements: what a cycle needs, what it gets, and what to change.

use runtime::realtime::threads::{self, Wishes};
use std::fs;

/// The report, one line per finding.
pub fn doctor() -> String {
    let mut lines = Vec::new();
    let mut line = |good: bool, what: &str, remedy: &str| {
        let (mark, remedy) = if good { ("✓", String::new()) } else { ("✗", format!(": {remedy}")) };
        lines.push(format!("{mark} {what}{remedy}"));
    };
    let read = |path: &str| fs::read_to_string(path).unwrap_or_default().trim().to_string();
    line(
        read("/sys/kernel/realtime") == "1",
        "a kernel with full preemption",
        "install one (Debian: linux-image-rt-amd64), or expect late cycles under load",
    );
    let core = threads::isolated_core();
    line(
        core.is_some(),
        "a core of its own for the cycle",
        "boot with `isolcpus=3 nohz_full=3 rcu_nocbs=3` on a computer with four cores",
    );
    let clock = read("/sys/devices/system/clocksource/clocksource0/current_clocksource");
    line(
        matches!(clock.as_str(), "tsc" | "arch_sys_counter" | "kvm-clock"),
        &format!("a fast clock ({})", if clock.is_empty() { "unknown" } else { &clock }),
        "boot with `tsc=reliable` if the processor's counter is sound",
    );
    let governor = read("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor");
    line(
        governor.is_empty() || governor == "performance",
        "a constant processor clock",
        "`echo performance | tee /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor`",
    );
    let entered = threads::enter(&Wishes::of_cycle());
    let refused = entered.refused();
    line(refused.is_empty(), "priority, memory and wakefulness granted", "see below");
    lines.extend(refused.iter().map(|refusal| format!("  {refusal}")));
    lines.join("\n") + "\n"
}
