//! How much memory a network may take.

use std::fs;
use std::path::Path;

/// Bytes that are free, or held only to save reading files again: of the machine or of the control group in which the
/// program runs, whichever is less. `None` where the system does not say.
pub(crate) fn available() -> Option<u64> {
    let machine = of_machine(&fs::read_to_string("/proc/meminfo").ok()?)?;
    let group = fs::read_to_string("/proc/self/cgroup").ok().and_then(|text| of_group(&text));
    Some(group.map_or(machine, |group| group.min(machine)))
}

fn of_machine(meminfo: &str) -> Option<u64> {
    let line = meminfo.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?;
    let kibibytes: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kibibytes.saturating_mul(1024))
}

/// Version 2 of control groups: the limit less what is used and cannot be dropped.
fn of_group(membership: &str) -> Option<u64> {
    let path = membership.lines().find_map(|line| line.strip_prefix("0::/"))?;
    let folder = Path::new("/sys/fs/cgroup").join(path);
    let read = |name: &str| fs::read_to_string(folder.join(name)).ok();
    let number = |name: &str| read(name)?.trim().parse::<u64>().ok();
    let dropped_first = read("memory.stat").and_then(|text| of_stat(&text)).unwrap_or(0);
    let used = number("memory.current")?.saturating_sub(dropped_first);
    Some(number("memory.max")?.saturating_sub(used))
}

fn of_stat(stat: &str) -> Option<u64> {
    stat.lines().find_map(|line| line.strip_prefix("inactive_file "))?.trim().parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_systems_words_are_understood() {
        let meminfo = "MemTotal:       24615932 kB\nMemAvailable:   23000000 kB\nBuffers: 1 kB\n";
        assert_eq!(of_machine(meminfo), Some(23_000_000 * 1024));
        assert_eq!(of_machine("MemTotal: 5 kB\n"), None);
        assert_eq!(of_machine("MemAvailable: much\n"), None);
        assert_eq!(of_stat("anon 5\ninactive_file 77\nactive_file 3\n"), Some(77));
        assert_eq!(of_group("1:memory:/x\n"), None);
        if cfg!(target_os = "linux") {
            assert!(available().is_some_and(|bytes| bytes > 1 << 20));
        }
    }
}
