//! Certificates, made with openssl as `docs/many-machines.md` shows it.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use super::skip::skip;

/// An authority and what it has signed, in a folder.
pub struct Authority(PathBuf);

impl Authority {
    /// Makes an authority; nothing where openssl is not installed.
    #[track_caller]
    pub fn create(folder: &Path) -> Option<Self> {
        if Command::new("openssl").arg("version").stdout(Stdio::null()).status().is_err() {
            skip("openssl (apt-get install openssl)");
            return None;
        }
        std::fs::create_dir_all(folder).unwrap();
        let authority = Self(folder.to_owned());
        authority.openssl(
            "req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 30 -subj /CN=lab -keyout ca.key -out ca.pem",
        );
        Some(authority)
    }

    /// Makes a certificate for a name; `also`: what else the certificate is for. `days`: its validity; -1 has expired.
    pub fn sign(&self, name: &str, also: &str, days: i32) {
        self.openssl(&format!(
            "req -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -subj /CN={name} -keyout {name}.key -out {name}.csr"
        ));
        let extensions = format!("subjectAltName={also}\nextendedKeyUsage=serverAuth,clientAuth\n");
        std::fs::write(self.0.join(format!("{name}.ext")), extensions).unwrap();
        self.openssl(&format!(
            "x509 -req -in {name}.csr -CA ca.pem -CAkey ca.key -CAcreateserial -days {days} -extfile {name}.ext -out {name}.pem"
        ));
    }

    /// Gives a folder to a user or a computer: the authority's certificate, and the certificate and key of a name.
    pub fn give(&self, name: &str, to: &Path) {
        std::fs::create_dir_all(to).unwrap();
        for file in ["ca.pem".to_owned(), format!("{name}.pem"), format!("{name}.key")] {
            std::fs::copy(self.0.join(&file), to.join(&file)).unwrap();
        }
    }

    /// Path of one of its files.
    pub fn file(&self, name: &str) -> String {
        self.0.join(name).display().to_string()
    }

    fn openssl(&self, arguments: &str) {
        let made = Command::new("openssl").args(arguments.split(' ')).current_dir(&self.0).output().unwrap();
        assert!(made.status.success(), "openssl {arguments}: {}", String::from_utf8_lossy(&made.stderr));
    }
}
