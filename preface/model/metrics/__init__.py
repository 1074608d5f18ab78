"""How like two images are: PSNR and SSIM (`image_quality`), LPIPS (`lpips`, whose weights `lpips_weights` gets)."""
