"""The closed loop: methods that plan again and again while loads go their own way, and what that costs."""
