//! The serial devices of this computer that may be arms, and which USB device each of them is.

use std::fs;
use std::path::Path;

/// Names of serial devices that may be arms.
const NAMES: [&str; 5] = ["ttyUSB", "ttyACM", "ttyAMA", "ttyTHS", "ttymxc"];
/// A port's USB device is at most this many folders above it.
const ABOVE: usize = 4;

/// A serial device.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SerialPort {
    /// Its path: `/dev/ttyACM0`. It may change when the cable is plugged in again.
    pub path: String,
    /// A link that is the same each time: `/dev/serial/by-id/…`.
    pub by_id: Option<String>,
    /// Its USB device, if it is one.
    pub usb: Option<Usb>,
}

/// A USB device.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Usb {
    /// Vendor and product: `1a86:55d3`.
    pub id: String,
    /// What it says that it is.
    pub product: Option<String>,
    /// Its serial number.
    pub serial: Option<String>,
    /// Where it is plugged in: `1-2` is bus and port.
    pub place: String,
}

/// Returns the USB device at an arm's address, a serial port or a network interface: its ids with its serial number, or
/// with where it is plugged in. `None` for what is no USB device.
pub fn usb_at(address: &str) -> Option<String> {
    usb_at_in(Path::new("/sys/class"), address)
}

fn usb_at_in(classes: &Path, address: &str) -> Option<String> {
    // `/dev/ttyACM0@115200`, `slcan:/dev/ttyACM0`, `can0`
    let device = match address.find('/').and_then(|at| address.get(at..)) {
        Some(path) => {
            let path = path.rsplit_once('@').map_or(path, |(path, _)| path);
            let path = fs::canonicalize(path).unwrap_or_else(|_| path.into());
            classes.join("tty").join(path.file_name()?)
        }
        None => classes.join("net").join(address),
    };
    let Usb { id, serial, place, .. } = usb(&device.join("device"))?;
    Some(match serial {
        Some(serial) => format!("USB {id} serial {serial}"),
        None => format!("USB {id} at {place}"),
    })
}

/// Lists the serial devices by path. Opens none.
pub fn list() -> Vec<SerialPort> {
    list_in(Path::new("/dev"), Path::new("/sys/class/tty"))
}

fn list_in(dev: &Path, sys: &Path) -> Vec<SerialPort> {
    let mut names = names(dev);
    names.retain(|name| NAMES.iter().any(|known| name.starts_with(known)));
    names.sort_by_key(|name| (name.len(), name.clone()));
    let port = |name: String| SerialPort {
        by_id: by_id(&dev.join("serial/by-id"), &name),
        usb: usb(&sys.join(&name).join("device")),
        path: dev.join(&name).to_string_lossy().into_owned(),
    };
    names.into_iter().map(port).collect()
}

fn names(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    entries.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect()
}

/// Returns the link to a device.
fn by_id(folder: &Path, name: &str) -> Option<String> {
    let points = |link: &String| fs::read_link(folder.join(link)).is_ok_and(|to| to.file_name() == Some(name.as_ref()));
    let link = { names(folder) }.into_iter().find(points)?;
    Some(folder.join(link).to_string_lossy().into_owned())
}

/// Returns the USB device of a port.
fn usb(device: &Path) -> Option<Usb> {
    let device = device.canonicalize().ok()?;
    let read = |folder: &Path, name: &str| Some(fs::read_to_string(folder.join(name)).ok()?.trim().to_owned());
    device.ancestors().take(ABOVE).find_map(|folder| {
        let id = format!("{}:{}", read(folder, "idVendor")?, read(folder, "idProduct")?);
        let serial = read(folder, "serial").filter(|serial| !serial.is_empty());
        let place = folder.file_name()?.to_string_lossy().into_owned();
        Some(Usb { id, product: read(folder, "product"), serial, place })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::symlink;

    #[test]
    fn usb_ports_have_their_ids() {
        let root = tempfile::tempdir().unwrap();
        let at = |path: &str| root.path().join(path);
        for folder in [
            "dev/serial/by-id",
            "sys/class/tty/ttyACM0",
            "sys/class/tty/ttyUSB10",
            "sys/usb/1-2/1-2:1.0",
            "sys/usb/1-3/1-3:1.0/ttyUSB10",
        ] {
            fs::create_dir_all(at(folder)).unwrap();
        }
        for name in ["ttyACM0", "ttyUSB10", "ttyUSB9", "tty0", "null"] {
            fs::write(at("dev").join(name), "").unwrap();
        }
        symlink("../../ttyACM0", at("dev/serial/by-id/usb-1a86_USB_Single_Serial_5A46-if00")).unwrap();
        symlink("../../../usb/1-2/1-2:1.0", at("sys/class/tty/ttyACM0/device")).unwrap();
        symlink("../../../usb/1-3/1-3:1.0/ttyUSB10", at("sys/class/tty/ttyUSB10/device")).unwrap();
        for (device, vendor, product) in [("1-2", "1a86", "55d3"), ("1-3", "0403", "6014")] {
            fs::write(at("sys/usb").join(device).join("idVendor"), format!("{vendor}\n")).unwrap();
            fs::write(at("sys/usb").join(device).join("idProduct"), format!("{product}\n")).unwrap();
        }
        fs::write(at("sys/usb/1-2/product"), "USB Single Serial\n").unwrap();
        let ports = list_in(&at("dev"), &at("sys/class/tty"));
        let found: Vec<_> =
            ports.iter().map(|p| (p.path.rsplit_once('/').unwrap().1, p.usb.as_ref().map(|u| u.id.as_str()))).collect();
        assert_eq!(found, [("ttyACM0", Some("1a86:55d3")), ("ttyUSB9", None), ("ttyUSB10", Some("0403:6014"))]);
        assert_eq!(ports[0].usb.as_ref().unwrap().product.as_deref(), Some("USB Single Serial"));
        assert!(ports[0].by_id.as_ref().unwrap().ends_with("/usb-1a86_USB_Single_Serial_5A46-if00"));
        assert!(list_in(&at("nothing"), &at("nothing")).is_empty());

        // Which adapter an arm is connected with.
        fs::write(at("sys/usb/1-2/serial"), "5A46\n").unwrap();
        fs::create_dir_all(at("sys/class/net/can0")).unwrap();
        symlink("../../../usb/1-3/1-3:1.0", at("sys/class/net/can0/device")).unwrap();
        let usb = |address: &str| usb_at_in(&at("sys/class"), address);
        let by_id = at("dev/serial/by-id/usb-1a86_USB_Single_Serial_5A46-if00").display().to_string();
        for address in ["/dev/ttyACM0", "/dev/ttyACM0@500000", "slcan:/dev/ttyACM0", &by_id] {
            assert_eq!(usb(address).as_deref(), Some("USB 1a86:55d3 serial 5A46"), "{address}");
        }
        assert_eq!(usb("/dev/ttyUSB10@1000000").as_deref(), Some("USB 0403:6014 at 1-3"));
        assert_eq!(usb("can0").as_deref(), Some("USB 0403:6014 at 1-3"));
        for none in ["/dev/pts/3", "/dev/ttyUSB9", "192.168.1.5:502", "sim", "", "/"] {
            assert_eq!(usb(none), None, "{none}");
        }
    }
}
