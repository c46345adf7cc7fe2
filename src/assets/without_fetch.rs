#![cfg(not(feature = "fetch"))]

use std::fs;

use super::*;

#[test]
fn without_the_feature_what_is_not_in_the_cache_is_refused_with_a_hint() {
    let folder = tempfile::tempdir().unwrap();
    let cache = Cache::at(folder.path());
    let asset = Asset {
        name: "arm".into(),
        url: "https://x.invalid/arm.zip".into(),
        sha256: "ab".repeat(32),
        place: "cell.yaml:3:5".into(),
    };
    let error = cache.fetch(&asset, &mut NoProgress).unwrap_err();
    assert!(error.what.starts_with("cell.yaml:3:5: the asset `arm`: not in the cache"), "{error}");
    assert!(error.hint.unwrap().contains(&cache.folder(&asset.sha256).display().to_string()));
    fs::create_dir_all(cache.folder(&asset.sha256)).unwrap();
    assert_eq!(cache.fetch(&asset, &mut NoProgress).unwrap(), cache.folder(&asset.sha256));
}
