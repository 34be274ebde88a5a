//! Keys and signatures in the format of minisign. The only file that uses `minisign` and `ct_codecs`.
//!
//! In: key files, bytes. Out: a key pair as texts, a signature as text. The signer mixes randomness into each
//! signature, so that fault attacks do not reveal its key: two signatures of equal bytes differ, and both are valid.

use ct_codecs::{Base64, Decoder};
use minisign::{KeyPair, PublicKey, SecretKey, SecretKeyBox};
use std::path::Path;

/// Generates a key pair: the secret key without a password, as by `minisign -G -W`, and the public key.
///
/// # Errors
/// Why the system has none.
pub fn new_pair() -> Result<(String, String), String> {
    let KeyPair { pk, sk } = KeyPair::generate_unencrypted_keypair().map_err(|error| error.to_string())?;
    let secret = sk.to_box(Some("fric secret key")).map_err(|error| error.to_string())?;
    let public = pk.to_box().map_err(|error| error.to_string())?;
    Ok((secret.into_string(), public.into_string()))
}

/// A secret key with its public key.
pub struct Signing {
    secret: SecretKey,
    public: PublicKey,
}

impl Signing {
    /// Reads the secret key in a file. If it has a password, prompts for it on the terminal.
    ///
    /// # Errors
    /// Why it cannot be used, in words.
    pub fn open(key: &Path) -> Result<Signing, String> {
        let text = std::fs::read_to_string(key).map_err(|error| format!("cannot read {}: {error}", key.display()))?;
        let about = |error: minisign::PError| format!("{} is no secret key of minisign: {error}", key.display());
        let boxed = || SecretKeyBox::from_string(&text).map_err(about);
        let secret = match SecretKey::from_unencrypted_box(boxed()?).or_else(|why| unchecked(&text).ok_or(why)) {
            Ok(secret) => secret,
            Err(_) => SecretKey::from_box(boxed()?, None).map_err(about)?,
        };
        let public = PublicKey::from_secret_key(&secret).map_err(about)?;
        Ok(Signing { secret, public })
    }

    /// The public key in base64, as in the last line of its file.
    pub fn public(&self) -> String {
        self.public.to_base64()
    }

    /// Signs bytes. The signature also covers `comment`.
    ///
    /// # Errors
    /// Why not, in words.
    pub fn sign(&self, bytes: &[u8], comment: &str) -> Result<String, String> {
        let untrusted = Some("signature of a fric package");
        let signature = minisign::sign(Some(&self.public), &self.secret, bytes, Some(comment), untrusted);
        Ok(signature.map_err(|error| format!("cannot sign: {error}"))?.into_string())
    }
}

/// A key without a password in the format of the stock tool: with zeros in place of its checksum.
fn unchecked(text: &str) -> Option<SecretKey> {
    // Position of the key derivation function, and length of the checksum at the end.
    const KDF: std::ops::Range<usize> = 2..4;
    const CHECKSUM: usize = 32;
    let bytes = Base64::decode_to_vec(text.lines().nth(1)?, None).ok()?;
    let plain = bytes.get(KDF)? == [0, 0] && bytes.iter().rev().take(CHECKSUM).all(|byte| *byte == 0);
    if plain { SecretKey::from_bytes(&bytes).ok() } else { None }
}

#[cfg(test)]
mod tests {
    use super::*;
    use runtime::package::signature::{Signer, Trusted, comment};

    #[test]
    fn a_signature_is_that_of_its_bytes_and_key_and_of_no_others() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("target").join("tmp").join("sign");
        let _ = std::fs::remove_dir_all(&folder);
        let trusted = folder.join("trusted");
        std::fs::create_dir_all(&trusted).unwrap();
        let (secret, public) = new_pair().unwrap();
        let (key, bytes) = (folder.join("a.key"), b"a package".as_slice());
        std::fs::write(&key, secret).unwrap();
        let sign = |at_s| Signing::open(&key)?.sign(bytes, &comment("rig rtfs", at_s));
        let signed = sign(1_764_000_000).unwrap();
        let none = Trusted::in_folder(&folder.join("nothing")).unwrap();
        assert_eq!(none.signer(bytes, None), Ok(None));
        std::fs::write(trusted.join("anna.pub"), &public).unwrap();
        let keys = Trusted::in_folder(&trusted).unwrap();
        let anna = |at_s| Ok(Some(Signer { name: "anna".into(), signed_s: Some(at_s) }));
        assert_eq!(keys.signer(bytes, Some(&signed)), anna(1_764_000_000));
        assert_eq!(keys.signer(bytes, Some(&sign(1_764_000_001).unwrap())), anna(1_764_000_001));
        // The signature covers the time.
        let forged = signed.replace("timestamp:1764000000", "timestamp:1964000000");
        assert!(forged != signed && keys.signer(bytes, Some(&forged)).is_err());
        let why = keys.signer(bytes, None).unwrap_err().to_string();
        assert!(why.starts_with("it is not signed, and this computer trusts anna only"), "{why}");
        for at in 0..bytes.len() {
            let mut changed = bytes.to_vec();
            changed[at] ^= 1;
            assert!(keys.signer(&changed, Some(&signed)).is_err(), "byte {at}");
        }
        // Any flipped bit of the signature proper; the first line is a comment and not covered.
        let begin = signed.find('\n').unwrap() + 1;
        for at in begin..signed.len() {
            let mut changed = signed.clone().into_bytes();
            changed[at] ^= 1;
            let Ok(changed) = String::from_utf8(changed) else { continue };
            if changed.lines().eq(signed.lines()) {
                continue; // a line end in another form
            }
            assert!(keys.signer(bytes, Some(&changed)).is_err(), "byte {at}: {changed}");
        }
        let (_, other) = new_pair().unwrap();
        std::fs::write(trusted.join("anna.pub"), other).unwrap();
        let keys = Trusted::in_folder(&trusted).unwrap();
        let why = keys.signer(bytes, Some(&signed)).unwrap_err().to_string();
        assert_eq!(why, "its signature is not that of anna, whom this computer trusts");
        std::fs::write(trusted.join("anna.pub"), "nonsense").unwrap();
        assert!(Trusted::in_folder(&trusted).is_err(), "a key that protects is not passed over");
        let why = Signing::open(&trusted.join("anna.pub")).err().unwrap();
        assert!(why.contains("is no secret key of minisign"), "{why}");
    }
}
