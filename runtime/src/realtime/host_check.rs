//! Checks of this machine for a hard real-time loop, with the command that fixes each problem.
//!
//! In: `/proc` and `/sys`. Out: findings as plain data. Changes nothing.

use std::fs;
use std::path::{Path, PathBuf};

/// Assessment of a finding.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum Verdict {
    /// As it should be.
    Good,
    /// It works, but not optimally, and no command fixes it.
    Poor,
    /// A command improves it.
    Mend(String),
    /// No real drive may run like this; the command that fixes it.
    Forbids(String),
}

/// Result of one check.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Finding {
    /// The topic: `kernel`, `priority`, `can0`.
    pub topic: String,
    /// The observation.
    pub says: String,
    /// The assessment.
    pub verdict: Verdict,
}

impl Finding {
    /// A finding.
    pub fn new(topic: &str, says: impl Into<String>, verdict: Verdict) -> Finding {
        Finding { topic: topic.into(), says: says.into(), verdict }
    }
}

/// A machine, by its files below a root: `/`, or an artificial one in tests.
pub struct Host {
    root: PathBuf,
}

impl Default for Host {
    fn default() -> Host {
        Host { root: "/".into() }
    }
}

/// Bits of CapEff.
const CAP_IPC_LOCK: u32 = 14;
const CAP_SYS_NICE: u32 = 23;

impl Host {
    /// The machine whose files are below a folder.
    pub fn below(root: &Path) -> Host {
        Host { root: root.into() }
    }

    fn text(&self, path: &str) -> Option<String> {
        fs::read_to_string(self.root.join(path)).ok().map(|text| text.trim().to_string())
    }

    /// All findings about the machine itself, in the order of the report.
    pub fn findings(&self) -> Vec<Finding> {
        let core = self.text("sys/devices/system/cpu/isolated").filter(|list| !list.is_empty());
        let mut found = vec![self.kernel(), self.rights(), self.core(core.as_deref())];
        found.extend(self.governor(core.as_deref()));
        found.extend(self.sleep());
        found.extend(self.sibling());
        found.push(self.clock_source());
        found.extend(self.hypervisor());
        found
    }

    fn kernel(&self) -> Finding {
        let release = self.text("proc/sys/kernel/osrelease").unwrap_or_else(|| "unknown".into());
        if self.text("sys/kernel/realtime").as_deref() == Some("1") {
            return Finding::new("kernel", format!("PREEMPT_RT {release}"), Verdict::Good);
        }
        let mend = "a kernel with PREEMPT_RT; on Debian: apt install linux-image-rt-amd64";
        Finding::new("kernel", format!("{release} without PREEMPT_RT"), Verdict::Mend(mend.into()))
    }

    /// Priority and locked memory: by capability, or by limit.
    fn rights(&self) -> Finding {
        let status = self.text("proc/self/status").unwrap_or_default();
        let capable = status.lines().find_map(|line| line.strip_prefix("CapEff:"));
        let capable = capable.and_then(|bits| u64::from_str_radix(bits.trim(), 16).ok()).unwrap_or(0);
        let can = |bit: u32| capable >> bit & 1 == 1;
        let limits = self.text("proc/self/limits").unwrap_or_default();
        let limit = |name: &str| {
            let line = limits.lines().find_map(|line| line.strip_prefix(name))?;
            line.split_whitespace().next().map(str::to_string)
        };
        let priority = if can(CAP_SYS_NICE) { Some("99".into()) } else { limit("Max realtime priority") };
        let memory = if can(CAP_IPC_LOCK) { Some("unlimited".into()) } else { limit("Max locked memory") };
        let (priority, memory) = (priority.unwrap_or_else(|| "0".into()), memory.unwrap_or_else(|| "0".into()));
        let says = format!("SCHED_FIFO up to {priority}, locked memory {memory}");
        let enough = priority.parse::<u32>().is_ok_and(|priority| priority >= 90) && memory == "unlimited";
        let mend = "setcap cap_sys_nice,cap_ipc_lock=ep on the program, or LimitRTPRIO=95 and LimitMEMLOCK=infinity in its unit";
        Finding::new("priority", says, if enough { Verdict::Good } else { Verdict::Mend(mend.into()) })
    }

    fn core(&self, isolated: Option<&str>) -> Finding {
        let quiet = self.text("sys/devices/system/cpu/nohz_full").filter(|list| !list.is_empty() && list != "(null)");
        match (isolated, quiet) {
            (Some(core), Some(_)) => Finding::new("core", format!("{core} isolated, nohz_full"), Verdict::Good),
            (Some(core), None) => {
                let mend = Verdict::Mend(format!("kernel command line: nohz_full={core}"));
                Finding::new("core", format!("{core} isolated, with a periodic tick"), mend)
            }
            (None, _) => {
                let last = self.text("sys/devices/system/cpu/online").unwrap_or_default();
                let last = last.rsplit(['-', ',']).next().unwrap_or_default().to_string();
                let mend = match last.parse::<u32>() {
                    Ok(1..) => Verdict::Mend(format!("kernel command line: isolcpus={last} nohz_full={last}")),
                    // A single core cannot be reserved.
                    _ => Verdict::Poor,
                };
                Finding::new("core", "none isolated", mend)
            }
        }
    }

    fn governor(&self, isolated: Option<&str>) -> Option<Finding> {
        let core = isolated.and_then(|list| list.split(['-', ',']).next()).unwrap_or("0").to_string();
        let governor = self.text(&format!("sys/devices/system/cpu/cpu{core}/cpufreq/scaling_governor"))?;
        let mend = match governor.as_str() {
            "performance" => Verdict::Good,
            _ => Verdict::Mend(format!("cpupower -c {core} frequency-set -g performance")),
        };
        Some(Finding::new("governor", format!("{governor} on core {core}"), mend))
    }

    /// Exit latency of the deepest sleep state, and whether we may prevent it.
    fn sleep(&self) -> Option<Finding> {
        let state =
            |k: u32| self.text(&format!("sys/devices/system/cpu/cpu0/cpuidle/state{k}/latency"))?.parse::<u64>().ok();
        let deepest_us = (0..16).filter_map(state).max()?;
        let device = self.root.join("dev/cpu_dma_latency");
        let may = deepest_us <= 10 || fs::OpenOptions::new().write(true).open(device).is_ok();
        let mend = Verdict::Mend("setfacl -m u:$USER:rw /dev/cpu_dma_latency".into());
        let says =
            format!("deepest takes {deepest_us} µs to wake from{}", if may { ", held off in a run" } else { "" });
        Some(Finding::new("sleep", says, if may { Verdict::Good } else { mend }))
    }

    fn sibling(&self) -> Option<Finding> {
        let active = self.text("sys/devices/system/cpu/smt/active")?;
        (active == "1").then(|| {
            let mend = Verdict::Mend("echo off > /sys/devices/system/cpu/smt/control".into());
            Finding::new("sibling", "two threads share a core", mend)
        })
    }

    fn clock_source(&self) -> Finding {
        let source = self.text("sys/devices/system/clocksource/clocksource0/current_clocksource");
        let source = source.unwrap_or_else(|| "unknown".into());
        let fast = ["tsc", "kvm-clock", "hyperv_clocksource_tsc_page", "arch_sys_counter"].contains(&source.as_str());
        let mend = Verdict::Mend("kernel command line: tsc=reliable clocksource=tsc".into());
        Finding::new("clock", source, if fast { Verdict::Good } else { mend })
    }

    fn hypervisor(&self) -> Option<Finding> {
        let info = self.text("proc/cpuinfo")?;
        let flags = info.lines().find(|line| line.starts_with("flags"))?;
        let says = "a virtual machine: what its host does shows as lateness of milliseconds";
        flags.split_whitespace().any(|flag| flag == "hypervisor").then(|| Finding::new("machine", says, Verdict::Poor))
    }

    /// Priority of the thread that serves an interface's interrupts, where the kernel has such threads. It must be
    /// above a loop of this priority, otherwise a loop that spins never receives its answer.
    pub fn interrupt(&self, interface: &str, priority: i32) -> Option<Finding> {
        let processes = fs::read_dir(self.root.join("proc")).ok()?;
        processes.flatten().find_map(|process| {
            let id: u32 = process.file_name().to_str()?.parse().ok()?;
            let name = self.text(&format!("proc/{id}/comm"))?;
            // irq/27-can0
            (name.starts_with("irq/") && name.ends_with(&format!("-{interface}"))).then_some(())?;
            let stat = self.text(&format!("proc/{id}/stat"))?;
            // The name may contain spaces; field 3 follows its closing parenthesis, and rt_priority is field 40.
            let stands: i32 = stat.rsplit(')').next()?.split_whitespace().nth(37)?.parse().ok()?;
            let says = format!("{name} FIFO {stands}, loop {priority}");
            let above = Verdict::Mend(format!("chrt -f -p {} {id}", priority + 5));
            Some(Finding::new("interrupt", says, if stands > priority { Verdict::Good } else { above }))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn machine(files: &[(&str, &str)]) -> (tempfile::TempDir, Host) {
        let root = tempfile::tempdir().expect("a folder");
        for (path, text) in files {
            let path = root.path().join(path);
            fs::create_dir_all(path.parent().expect("in a folder")).expect("made");
            fs::write(path, text).expect("written");
        }
        let host = Host::below(root.path());
        (root, host)
    }

    fn verdict<'f>(found: &'f [Finding], topic: &str) -> &'f Verdict {
        &found.iter().find(|finding| finding.topic == topic).unwrap_or_else(|| panic!("{topic} in {found:?}")).verdict
    }

    #[test]
    fn a_prepared_machine_is_good() {
        let (_root, host) = machine(&[
            ("proc/sys/kernel/osrelease", "6.1.0-rt\n"),
            ("sys/kernel/realtime", "1\n"),
            ("proc/self/status", "Name:\tfric\nCapEff:\t000001ffffffffff\n"),
            ("sys/devices/system/cpu/isolated", "3\n"),
            ("sys/devices/system/cpu/nohz_full", "3\n"),
            ("sys/devices/system/cpu/cpu3/cpufreq/scaling_governor", "performance\n"),
            ("sys/devices/system/cpu/cpu0/cpuidle/state0/latency", "0\n"),
            ("sys/devices/system/cpu/cpu0/cpuidle/state3/latency", "890\n"),
            ("dev/cpu_dma_latency", ""),
            ("sys/devices/system/cpu/smt/active", "0\n"),
            ("sys/devices/system/clocksource/clocksource0/current_clocksource", "tsc\n"),
            ("proc/cpuinfo", "flags\t: fpu sse2\n"),
        ]);
        let found = host.findings();
        assert!(found.iter().all(|finding| finding.verdict == Verdict::Good), "{found:?}");
        assert_eq!(found[0].says, "PREEMPT_RT 6.1.0-rt");
        assert_eq!(found[1].says, "SCHED_FIFO up to 99, locked memory unlimited");
    }

    #[test]
    fn a_problem_is_reported_with_its_remedy() {
        let limits = "Limit                     Soft Limit           Hard Limit           Units\n\
                      Max locked memory         8388608              8388608              bytes\n\
                      Max realtime priority     0                    0\n";
        let (_root, host) = machine(&[
            ("proc/sys/kernel/osrelease", "6.1.0\n"),
            ("proc/self/status", "CapEff:\t0000000000000000\n"),
            ("proc/self/limits", limits),
            ("sys/devices/system/cpu/isolated", "\n"),
            ("sys/devices/system/cpu/online", "0-3\n"),
            ("sys/devices/system/cpu/cpu0/cpufreq/scaling_governor", "powersave\n"),
            ("sys/devices/system/cpu/smt/active", "1\n"),
            ("sys/devices/system/clocksource/clocksource0/current_clocksource", "hpet\n"),
            ("proc/cpuinfo", "flags\t\t: fpu hypervisor\n"),
        ]);
        let found = host.findings();
        let mend = |topic| match verdict(&found, topic) {
            Verdict::Mend(line) => line.clone(),
            other => panic!("{topic}: {other:?}"),
        };
        assert!(mend("kernel").contains("linux-image-rt-amd64"));
        assert!(mend("priority").contains("LimitRTPRIO=95"));
        assert_eq!(mend("core"), "kernel command line: isolcpus=3 nohz_full=3");
        assert_eq!(mend("governor"), "cpupower -c 0 frequency-set -g performance");
        assert!(mend("sibling").contains("smt/control"));
        assert!(mend("clock").contains("clocksource=tsc"));
        assert_eq!(*verdict(&found, "machine"), Verdict::Poor);
        assert_eq!(found[1].says, "SCHED_FIFO up to 0, locked memory 8388608");
    }

    #[test]
    fn the_priority_of_an_interrupt_thread_must_exceed_the_loop() {
        let stat = |priority| format!("312 (irq/27-can0) S 2 {}{priority} 1 0\n", "0 ".repeat(35));
        let low = stat(50);
        let (_root, host) = machine(&[("proc/312/comm", "irq/27-can0\n"), ("proc/312/stat", &low)]);
        let found = host.interrupt("can0", 80).expect("there is a thread");
        assert_eq!(found.verdict, Verdict::Mend("chrt -f -p 85 312".into()));
        assert_eq!(found.says, "irq/27-can0 FIFO 50, loop 80");
        assert_eq!(host.interrupt("can1", 80), None);
        let high = stat(85);
        let (_root, host) = machine(&[("proc/312/comm", "irq/27-can0\n"), ("proc/312/stat", &high)]);
        assert_eq!(host.interrupt("can0", 80).map(|found| found.verdict), Some(Verdict::Good));
    }
}
